"""Settings of the process that must precede any numerical work."""

from __future__ import annotations

_MOST_DEVICES = 64


def start(chains: int) -> None:
    """Enable float64 and fast loops, and make one device for each chain, so that chains run side by side.

    JAX counts its devices once, when the first array is made; after that the number is fixed. With
    fewer cores than chains the devices share them, which still beats one chain after another.
    """
    import jax
    import numpyro

    from lfm_ppl.compilation import fast_loops

    jax.config.update("jax_enable_x64", True)
    fast_loops()
    numpyro.set_host_device_count(min(chains, _MOST_DEVICES))
