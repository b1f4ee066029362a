"""The forward scan, the backward scan, and what happens in a row."""
