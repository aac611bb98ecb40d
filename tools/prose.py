#!/usr/bin/env python3
"""Checks how long the sentences of pages are. Usage: prose.py PAGE.md or FOLDER …

Only running text counts: code, tables, headings, pictures, HTML and the targets of links are left out. A list item ends a
sentence. A page passes if its sentences have at most 17 words on average, 90 % of them at most 28, and none more than 40.
"""

import re
import sys
from pathlib import Path

MEAN, MOST, MAX = 17, 28, 40
ITEM = re.compile(r"^([-*+]|\d+[.)])\s+")
ABBREVIATION = re.compile(r"\b(e\.g|i\.e|etc|vs|cf|Sec|Fig|Eq|al)\.")
END = re.compile(r"(?<=[.!?:;])\s+(?=[A-Z\"(`*\d])|(?<=[.!?])\s+")


def paragraphs(text):
    """The blocks of running text of a page."""
    text = re.sub(r"(?ms)^\s*(```|~~~).*?^\s*\1\s*$", "", text)
    text = re.sub(r"(?s)<!--.*?-->", "", text)
    block = []
    for line in map(str.strip, text.split("\n")):
        left_out = not line or line.startswith(("|", "#", "![", "<"))
        if left_out or ITEM.match(line):
            yield " ".join(block)
            block = []
        if not left_out:
            block.append(ITEM.sub("", line, count=1))
    yield " ".join(block)


def sentences(text):
    """The sentences of a page, without what is not words."""
    for block in paragraphs(text):
        block = re.sub(r"`[^`]*`", "code", block)
        block = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", block)
        block = ABBREVIATION.sub(r"\1", block)
        for sentence in END.split(block):
            if len(re.findall(r"[A-Za-z]{2,}", sentence)) >= 2:
                yield sentence.strip()


def check(page):
    """Prints what is wrong with a page; true if nothing is."""
    found = sorted(((len(s.split()), s) for s in sentences(page.read_text(encoding="utf-8"))), reverse=True)
    if not found:
        return True
    lengths = [length for length, _ in found]
    mean, most = sum(lengths) / len(lengths), lengths[::-1][int(0.9 * (len(lengths) - 1))]
    if mean <= MEAN and most <= MOST and lengths[0] <= MAX:
        return True
    print(f"{page}: mean {mean:.1f} words a sentence (limit {MEAN}), 90 % at most {most} ({MOST}), longest {lengths[0]} ({MAX}):")
    for length, sentence in found[:3]:
        print(f"  {length}: {sentence[:160]}")
    return False


def main():
    paths = [Path(name) for name in sys.argv[1:]]
    if not paths:
        sys.exit(__doc__)
    pages = [page for path in paths for page in (sorted(path.rglob("*.md")) if path.is_dir() else [path])]
    wrong = [page for page in pages if not check(page)]
    sys.exit(f"{len(wrong)} of {len(pages)} pages have sentences that are too long: make two of one" if wrong else 0)


if __name__ == "__main__":
    main()
