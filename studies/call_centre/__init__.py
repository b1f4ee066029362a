"""Queues of a call centre, tracked through days with similar patterns of arrivals.

Source: S. Reece and others, Efficient state-space inference of periodic latent force models, JMLR 15 (2014), section 8.
"""
