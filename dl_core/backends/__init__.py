"""Painters on real diffusion models, and the models the package brings along."""
