# SPDX-License-Identifier: Apache-2.0
"""Write CHANGELOG.rst of both packages, in the form that bloom reads, from CHANGELOG.md (`make changelog`)."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {"flowing_puppet_ros": ROOT, "flowing_puppet_msgs": ROOT / "msg_defs"}


def make_changelog(package: str, markdown: str) -> str:
    """Return the changelog of a package: a section per version, `Forthcoming` for the one that is not released.

    A section begins with `## 1.2.3 (2026-01-31)` or `## 1.2.3 (unreleased)`. Both packages are released together and
    share the text.
    """
    title = f"Changelog for package {package}"
    lines = ["^" * len(title), title, "^" * len(title)]
    for section in re.split(r"^## ", markdown, flags=re.MULTILINE)[1:]:
        heading, _, text = section.partition("\n")
        heading = "Forthcoming" if "unreleased" in heading else heading.strip()
        items = re.findall(r"^- (.+(?:\n  .+)*)", text, flags=re.MULTILINE)
        lines += ["", heading, "-" * len(heading)]
        lines += [f"* {_to_rst(' '.join(item.split()))}" for item in items]
    return "\n".join(lines) + "\n"


def _to_rst(text: str) -> str:
    """Return a line of Markdown with its code, links and emphasis as reStructuredText."""
    text = re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", text)
    text = re.sub(r"\*\*([^*]+)\*\*", r"\1", text)
    spans = re.split(r"`([^`]+)`", text)
    plain = [re.sub(r"([*_|\\])", r"\\\1", span) for span in spans[::2]]
    # Code must end at a space or punctuation.
    after = [span if not span or re.match(r"[\s.,;:!?)/'-]", span) else f"\\ {span}" for span in plain[1:]]
    return plain[0] + "".join(f"``{code}``{rest}" for code, rest in zip(spans[1::2], after, strict=True))


if __name__ == "__main__":
    for name, folder in PACKAGES.items():
        (folder / "CHANGELOG.rst").write_text(make_changelog(name, (ROOT / "CHANGELOG.md").read_text()))
