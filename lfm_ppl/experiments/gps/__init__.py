"""Orbits of GPS and other satellites: predicted with and without forces that nobody measured."""
