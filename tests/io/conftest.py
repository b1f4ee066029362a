"""Files for the tests of this folder."""

import pytest


@pytest.fixture
def write(tmp_path):
    """Write a text to a file."""

    def write_file(text):
        path = tmp_path / "data.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write_file
