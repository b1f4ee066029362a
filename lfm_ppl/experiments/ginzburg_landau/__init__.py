"""The double well of Ginzburg and Landau: what a Gaussian filter costs in states and in parameters.

Source: J. Hartikainen, Sequential Inference for Latent Temporal Gaussian Process Models (2013), section 2.7.1.
"""
