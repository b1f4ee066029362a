"""Slower, more exact or simpler ways to the same quantities, for models that the Gaussian filter approximates."""
