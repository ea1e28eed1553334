"""`lightprobe train turbo`: a LoRA that paints at once what the iterative method arrives at."""
