"""Training: panoramas -> pictures with a chrome ball; the mini model's autoencoder, base, ControlNet and LoRA."""
