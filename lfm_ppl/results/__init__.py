"""Results: ArviZ containers, their files, summaries, scores and tables."""
