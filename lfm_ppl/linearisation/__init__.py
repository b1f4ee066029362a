"""Rules that turn a function and a Gaussian into an affine map."""
