"""`lightprobe train data`: pairs of photograph and chrome ball, from any panoramas, in shards."""
