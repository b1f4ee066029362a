"""Names of types in public signatures."""

from __future__ import annotations

from typing import Any, TypeAlias

Result: TypeAlias = Any
"""An ArviZ object: an InferenceData on ArviZ 0.23, an xarray.DataTree on 1.x."""

Times: TypeAlias = Any
"""Times (T,), numbers or dates; or times with data: an `lfm_ppl.Data`, a data frame or an xarray Dataset."""
