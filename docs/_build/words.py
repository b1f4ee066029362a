"""Line breaks in inline code: browsers break an option after its hyphens, as in ``--`` and ``sampler``.

1. A word of inline code that is no longer than a line of a phone stays in one line.
2. So does a number with a negative exponent in a table, as in ``2.1e-13``, and an arrow.
3. The heading of a public name may break after a dot: ``lfm_ppl.`` and ``NegativeBinomialObservation``.
"""

from __future__ import annotations

import re
from typing import Any

_INLINE_CODE = re.compile(r"(?<=<code>)[^<]+(?=</code>)")
_WORD = re.compile(r"(?<!\S)(?=\S*[^\w\s])\S{2,36}(?!\S)")
"""A word with a character other than letters, digits and underscores; an entity such as ``&quot;`` counts in full."""
_PREFORMATTED = re.compile(r"(<pre.*?</pre>)", re.DOTALL)
_ARROW = re.compile(r"(?<=\s)-&gt;(?=\s)")
_NUMBER = re.compile(r"(?<=<td>)-?[\d.]+e-\d+(?=</td>)")
_HEADING_NAME = re.compile(r'(?<=<span class="doc doc-object-name)( [^"]*">)([\w.]+)(?=</span>)')


def on_page_content(content: str, **_: Any) -> str:
    """Mark the words that stay in one line; called by MkDocs for each page."""
    parts = _PREFORMATTED.split(content)
    parts[::2] = [_in_prose(part) for part in parts[::2]]
    return "".join(parts)


def _in_prose(text: str) -> str:
    text = _INLINE_CODE.sub(lambda code: _WORD.sub(r'<span class="word">\g<0></span>', code[0]), text)
    for pattern in (_ARROW, _NUMBER):
        text = pattern.sub(r'<span class="word">\g<0></span>', text)
    return _HEADING_NAME.sub(lambda match: match[1] + match[2].replace(".", ".<wbr>"), text)
