"""Forces that cannot be negative: estimation under constraints, after Wolff, Lopez, Müller and Beckers.

Transcription with forces of four shapes, a ballistic target, and patients' pituitary and thyroid.
"""
