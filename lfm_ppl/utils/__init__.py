"""Linear algebra, checks, progress and other helpers without knowledge of latent force models."""
