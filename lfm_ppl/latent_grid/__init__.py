"""Forces on a grid of times, and the state as an explicit function of them."""
