"""Fields in space and time: the heat and wave equations, and separable processes."""
