"""Counts, outliers and binary data: errors of Gaussian factors against the exact posterior of a Gaussian process.

Sources: H. Nickisch, A. Solin and A. Grigorevskiy, State space Gaussian processes with non-Gaussian likelihood, ICML
(2018), section 4; J. Weinberg, L. Brown and J. Stroud, JASA 102 (2007).
"""
