"""GPS orbits: predicted with and without forces that nobody measured."""
