"""Everything that computes the error of a posterior: checks, references, corrections, verdicts."""
