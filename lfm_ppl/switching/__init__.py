"""Linear models with a discrete input under a known controller, and regimes of a Markov chain."""
