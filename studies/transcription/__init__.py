"""Transcription factors: the force behind gene expression by Laplace, elliptical slice sampling and Gaussian smoothers.

Source: J. Hartikainen, M. Seppanen and S. Sarkka, State-space inference for non-linear latent force models with
application to satellite orbit prediction (ICML 2012), section 5.1 and table 1.
"""
