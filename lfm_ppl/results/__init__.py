"""What to do with a result: keep it, summarise it, check it, draw it."""
