"""Bayesian inference in latent force models, on NumPyro.

The public names stand in ``__init__.pyi``. Each is imported at its first use, so that ``import lfm_ppl`` and
``lfm-ppl --help`` do not wait for JAX.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
