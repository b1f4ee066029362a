"""Particle methods: forces exact, states by stochastic Runge-Kutta steps."""
