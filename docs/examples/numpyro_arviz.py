"""One model under NumPyro's samplers, ArviZ's comparison and blackjax: python numpyro_arviz.py."""

# --8<-- [start:model]
import arviz as az
import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS, SVI, Predictive, Trace_ELBO
from numpyro.infer.autoguide import AutoMultivariateNormal

import lfm_ppl as lfm

jax.config.update("jax_enable_x64", True)


def gene(times, y=None, order=1):
    """A concentration x with production u and decay."""
    decay = numpyro.sample("decay", dist.LogNormal(0.0, 0.5))
    lengthscale = numpyro.sample("lengthscale", dist.LogNormal(0.5, 0.5))
    model = lfm.LatentForceModel(
        dynamics=lambda x, u, t: u - decay * x,
        forces={"production": lfm.Matern(1.0, lengthscale, order=order)},
        observation=lfm.GaussianObservation(lambda x, u, t: x, sd=0.1),
        initial_state=lfm.Gaussian(jnp.zeros(1), jnp.eye(1)),
        initial_time=-1.0,
    )
    numpyro.sample("y", lfm.MarginalLikelihood(model, times), obs=y)


times = jnp.linspace(0.0, 10.0, 21)
# --8<-- [end:model]

# --8<-- [start:prior]
prior = Predictive(gene, num_samples=200)(jax.random.key(0), times)
y = prior["y"][0]  # (21, 1), the first of 200 simulated data sets
# --8<-- [end:prior]

# --8<-- [start:mcmc]
def sample(**model_kwargs):
    """Sample with NumPyro's NUTS and convert the draws to an ArviZ object."""
    mcmc = MCMC(NUTS(gene), num_warmup=300, num_samples=300, num_chains=2,
                chain_method="vectorized", progress_bar=False)
    mcmc.run(jax.random.key(1), times, y, **model_kwargs)
    return lfm.to_arviz(mcmc, gene, times, y, model_kwargs=model_kwargs)


rough, smooth = sample(order=0), sample(order=2)
print(az.summary(smooth, var_names=["decay", "lengthscale"]))
# --8<-- [end:mcmc]

# --8<-- [start:compare]
print(az.loo(smooth))  # from 21 leave-one-out conditionals
print(az.compare({"rough": rough, "smooth": smooth}))
if hasattr(az, "psense_summary"):  # ArviZ 1.x
    print(az.loo_pit(smooth)["y"])
    print(az.psense_summary(smooth))  # sensitivity to the prior
    az.plot_ppc_dist(smooth)
    az.plot_ppc_pit(smooth)
# --8<-- [end:compare]

# --8<-- [start:svi]
guide = AutoMultivariateNormal(gene)
svi = SVI(gene, guide, numpyro.optim.Adam(0.02), Trace_ELBO())
fitted = svi.run(jax.random.key(2), 1000, times, y, progress_bar=False)
draws = guide.sample_posterior(jax.random.key(3), fitted.params,
                               sample_shape=(2, 200))  # chains, draws
variational = lfm.to_arviz(draws, gene, times, y)
# --8<-- [end:svi]

# --8<-- [start:bind]
bound = lfm.bind(gene, times, y)
z = bound.unconstrain({"decay": 1.0, "lengthscale": 1.5})
print(bound.names, bound.log_density(z), bound.log_density_gradient(z))
print(bound.smooth(z).force("production").mean)
# --8<-- [end:bind]
