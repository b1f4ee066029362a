"""Runs on disk: arrays by name in a locked folder, checkpoints of chains, records of settings, names of files."""
