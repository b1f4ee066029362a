"""An instance of every public linearisation rule, for tests of what holds for all of them."""

import lfm_ppl as lfm

RULES = [lfm.Taylor(), lfm.Cubature(), lfm.Cubature(full_state=True), lfm.Unscented(), lfm.Unscented(0.8, 2.0, 1.0),
         lfm.GaussHermite(3), lfm.GaussHermite(5), lfm.CentralDifference(), lfm.CentralDifference(1.2),
         lfm.MonteCarlo(50, seed=1)]
