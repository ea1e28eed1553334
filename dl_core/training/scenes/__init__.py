"""`lightprobe train scenes`: procedural panoramas, drawn in closed form or path traced."""
