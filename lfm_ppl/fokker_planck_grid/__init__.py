"""Densities of a one-dimensional state on a grid, by finite volumes in the Fokker-Planck equation."""
