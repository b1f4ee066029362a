"""The programs that XLA compiles, for tests of what compiles nothing."""

import contextlib
import logging

import jax


@contextlib.contextmanager
def compilations():
    """Collect the names of the functions that XLA compiles."""
    names = []

    class Handler(logging.Handler):
        def emit(self, record):
            # "stage" brings an array to the device.
            if record.getMessage().startswith("Finished XLA compilation") and "jit(stage)" not in record.getMessage():
                names.append(record.getMessage()[:120])

    logger, handler = logging.getLogger("jax"), Handler()
    propagate, previous_setting = logger.propagate, jax.config.jax_log_compiles
    logger.addHandler(handler)
    logger.propagate = False
    jax.config.update("jax_log_compiles", True)
    try:
        yield names
    finally:
        jax.config.update("jax_log_compiles", previous_setting)
        logger.removeHandler(handler)
        logger.propagate = propagate
