"""`lightprobe bench early`: what is lost and saved where less is denoised, decoded or drawn."""
