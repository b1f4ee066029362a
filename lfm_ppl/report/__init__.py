"""The report of a result, as one HTML page."""
