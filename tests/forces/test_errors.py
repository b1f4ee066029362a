"""Every wrong argument is named before anything is compiled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lfm_ppl.forces import Constant, Matern, SquaredExponential, WienerVelocity

WITH_LENGTHSCALE = [Matern, SquaredExponential]
NOT_POSITIVE = [0.0, -1.0, np.nan, np.inf]


@pytest.mark.parametrize("value", NOT_POSITIVE)
@pytest.mark.parametrize(
    ("make", "argument"),
    [(make, name) for make in WITH_LENGTHSCALE for name in ("scale", "lengthscale")]
    + [(WienerVelocity, "scale"), (Constant, "scale")],
)
def test_scales_must_be_positive(make, argument, value):
    good = {"scale": 1.0, "lengthscale": 1.0} if make in WITH_LENGTHSCALE else {"scale": 1.0}
    with pytest.raises(ValueError, match=f"^{argument} must be finite and greater than zero"):
        make(**{**good, argument: value})


@pytest.mark.parametrize("value", ["long", None, {"a": 1}])
def test_scales_must_be_numbers(value):
    with pytest.raises(TypeError, match="lengthscale must be numeric"):
        Matern(1.0, value)


def test_scales_must_be_one_number_even_as_tracers():
    with pytest.raises(ValueError, match=r"scale must be one number.*\(2,\).*vmap"):
        Matern(jnp.ones(2), 1.0)
    with pytest.raises(ValueError, match=r"lengthscale must be one number.*\(3,\)"):
        jax.jit(lambda ell: Matern(1.0, ell).feedback())(jnp.ones(3))


@pytest.mark.parametrize(
    ("make", "order", "allowed"),
    [(Matern, -1, "0, 1, 2, 3, 4, 5"), (Matern, 6, "0, 1, 2, 3, 4, 5")]
    + [(SquaredExponential, order, "2, 4, 6, 7, 8") for order in (0, 3, 10)],
)
def test_order_must_be_in_range(make, order, allowed):
    with pytest.raises(ValueError, match=f"order must be one of {allowed}, got {order}"):
        make(1.0, 1.0, order=order)


@pytest.mark.parametrize("make", WITH_LENGTHSCALE)
@pytest.mark.parametrize("order", [2.0, "2", True, None])
def test_order_must_be_a_python_int(make, order):
    with pytest.raises(TypeError, match="order must be a Python int.*cannot be sampled"):
        make(1.0, 1.0, order=order)


def test_order_cannot_be_traced():
    with pytest.raises(TypeError, match="order must be a Python int"):
        jax.jit(lambda order: Matern(1.0, 1.0, order=order).feedback())(2)


@pytest.mark.parametrize("argument", ["initial_value_sd", "initial_velocity_sd"])
def test_initial_deviations_are_not_negative(argument):
    with pytest.raises(ValueError, match=f"{argument} .*must be >= 0, got -1"):
        WienerVelocity(1.0, **{argument: -1.0})
    with pytest.raises(ValueError, match=f"{argument} must be finite"):
        WienerVelocity(1.0, **{argument: np.nan})
    assert WienerVelocity(1.0, **{argument: 0.0}).state_dim == 2


@pytest.mark.parametrize("make", [Matern, SquaredExponential, WienerVelocity, Constant])
def test_the_mean_is_a_number_or_a_function(make):
    arguments = (1.0, 1.0) if make in WITH_LENGTHSCALE else (1.0,)
    with pytest.raises(TypeError, match="mean must be numeric"):
        make(*arguments, mean="zero")
    with pytest.raises(ValueError, match="mean must be finite"):
        make(*arguments, mean=np.nan)
    with pytest.raises(ValueError, match="mean must be one number"):
        make(*arguments, mean=[1.0, 2.0])
