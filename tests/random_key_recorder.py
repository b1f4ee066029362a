"""The random keys that a computation consumes, also inside of compiled code."""

import collections
import contextlib
import sys
from pathlib import Path

import jax
import numpy as np

SAMPLERS = ("bernoulli", "beta", "binomial", "bits", "categorical", "cauchy", "chisquare", "choice", "dirichlet",
            "exponential", "gamma", "gumbel", "laplace", "loggamma", "logistic", "multivariate_normal", "normal",
            "permutation", "poisson", "rademacher", "randint", "t", "truncated_normal", "uniform")
FIXED_SEEDS = (0, 1)
"""Seeds of what the library draws with the same numbers in every run, such as points to read shapes from."""

PACKAGE = str(Path(__file__).resolve().parents[1] / "lfm_ppl")


class KeyRecord:
    """Consumers of keys.

    Attributes:
        consumers: data of a key -> how it was consumed, and the lines of the library that did.
        children: data of a key -> data of the keys into which it was split.
    """

    def __init__(self):
        self.consumers = collections.defaultdict(list)
        self.children = collections.defaultdict(set)

    def add(self, keys, use, line):
        for words in rows(keys):
            self.consumers[words].append((use, line))

    def add_children(self, key, children):
        for words in rows(key):
            self.children[words].update(rows(children))

    def fixed(self):
        """Return the keys that come from `FIXED_SEEDS`."""
        keys, queue = set(), []
        for seed in FIXED_SEEDS:
            queue += rows(jax.random.key_data(jax.random.key(seed)))
        while queue:
            words = queue.pop()
            if words not in keys:
                keys.add(words)
                queue += self.children[words]
        return keys

    def reused(self):
        """Return the lines that consumed one key more than once: a sample, a split, or two equal fold_ins."""
        jax.effects_barrier()
        lines, fixed = collections.Counter(), self.fixed()
        for words, consumers in self.consumers.items():
            if words in fixed:
                continue
            folded = [use for use, _ in consumers if use.startswith("fold_in")]
            if len(folded) < len(consumers) > 1 or len(set(folded)) < len(folded):
                lines[" | ".join(sorted({f"{use} at {line}" for use, line in consumers}))] += 1
        return dict(lines)


def rows(keys):
    """Return the data of keys as tuples."""
    return [tuple(words.tolist()) for words in np.asarray(keys).reshape(-1, np.shape(keys)[-1])]


def _line():
    frame = sys._getframe(2)
    while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
        frame = frame.f_back
    return "outside" if frame is None else f"{Path(frame.f_code.co_filename).relative_to(PACKAGE)}:{frame.f_lineno}"


@contextlib.contextmanager
def recorded_keys(monkeypatch):
    """Record the keys that reach the functions of ``jax.random``, from new programs: the compiled ones are dropped.

    A function is traced with a callback that receives the key's data, so that keys of loops and of batches count too.
    """
    record = KeyRecord()

    def recording(name):
        function = getattr(jax.random, name)

        def call(key, *args, **kwargs):
            line = _line()
            if name == "fold_in":
                data = kwargs["data"] if "data" in kwargs else args[0]
                jax.debug.callback(lambda words, data: record.add(words, f"fold_in {data}", line),
                                   jax.random.key_data(key), data)
            else:
                jax.debug.callback(lambda words: record.add(words, name, line), jax.random.key_data(key))
            result = function(key, *args, **kwargs)
            if name in ("fold_in", "split"):
                jax.debug.callback(record.add_children, jax.random.key_data(key), jax.random.key_data(result))
            return result

        return call

    jax.clear_caches()
    with monkeypatch.context() as patch:
        for name in ("split", "fold_in", *SAMPLERS):
            patch.setattr(jax.random, name, recording(name))
        yield record
    jax.clear_caches()
