"""The double well of Ginzburg and Landau: errors of Gaussian filters in states and parameters.

Source: J. Hartikainen, Sequential Inference for Latent Temporal Gaussian Process Models (2013), section 2.7.1.
"""
