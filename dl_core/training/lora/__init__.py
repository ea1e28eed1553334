"""`lightprobe train lora`: the exposure LoRA, of SDXL or of the mini model."""
