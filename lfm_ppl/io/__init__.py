"""Data files and model files."""

from lfm_ppl.io import data as data
from lfm_ppl.io import datasets as datasets
