"""A target on reentry, tracked by its distance: Gaussian smoothers, particles, and the posterior of the drag.

Source: J. Hartikainen, M. Seppanen and S. Sarkka, State-space inference for non-linear latent force models (ICML 2012),
section 5.2.
"""
