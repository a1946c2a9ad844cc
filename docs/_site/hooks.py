"""What the site adds to MkDocs: documents and files of the repository outside docs/ that a page links to.

They get the place `repository/…` in the site, and links to them are bent there, so that pages stay as they are in the
repository and every link leads somewhere when the site is opened from disk.
"""

from __future__ import annotations

import logging
import os
import posixpath
import re
import sys
from pathlib import Path

from mkdocs.structure.files import File, Files

sys.path.append(os.fspath(Path(__file__).resolve().parent))
import formulas  # noqa: E402  (beside this file, which is no package)

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"(\]\()([^)#\s]+)([^)]*\))")
LOADED = re.compile(r"<(?:script|link|img|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
NOT_RUN = re.compile(r"^<!-- not run: (.+?) -->$", re.MULTILINE)
PLACE = "repository"
NAMED = re.compile(  # a section of the navigation, by a label that may be hidden
    r'(<nav class="md-nav" data-md-level="\d+") aria-labelledby="\w+"'
    r'([^>]*>\s*<label class="md-nav__title"[^>]*>\s*<span[^>]*></span>\s*)([^<]*[^<\s])'
)
ALWAYS = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "examples/README.md",
    "benchmarks/README.md",
)


def place(path: str) -> str:
    """The place in the site of a file, both named from the root of the repository and of the site."""
    return path.removeprefix("docs/") if path.startswith("docs/") else f"{PLACE}/{path}"


def origin(uri: str) -> str:
    """The other way round."""
    return uri.removeprefix(f"{PLACE}/") if uri.startswith(f"{PLACE}/") else f"docs/{uri}"


def targets(text: str, source: str) -> dict[str, str]:
    """The links of a document to files that exist, and where these are in the repository."""
    found = {}
    for _, link, _ in LINK.findall(text):
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), link))
        if "://" not in link and not path.startswith("..") and (ROOT / path).is_file():
            found[link] = path
    return found


def on_files(files: Files, config) -> Files:
    """Adds what lies outside docs/: the project's own pages, and each file that some page links to."""
    waiting = [*ALWAYS, *(origin(file.src_uri) for file in files.documentation_pages())]
    known = {origin(file.src_uri) for file in files}
    while waiting:
        path = waiting.pop()
        if path not in known:
            files.append(File.generated(config, place(path), abs_src_path=os.fspath(ROOT / path)))
            known.add(path)
        if path.endswith(".md"):
            linked = targets((ROOT / path).read_text(encoding="utf-8"), path)
            waiting += [one for one in linked.values() if one not in known]
    return files


def on_config(config):
    """Without a page for addresses that are not there: opened from disk it finds none of its own files."""
    config.theme.static_templates.discard("404.html")
    return config


def boost(uri: str) -> float:
    """How much a page counts in the search: what shows how to do something comes before lists of names."""
    room = uri.partition("/")[0]
    return {"reference": 0.2, PLACE: 0.1, "decisions": 0.3, "notation.md": 0.3}.get(room, 3.0)


def on_page_markdown(markdown: str, page, config, files: Files) -> str:
    """Bends the links of a page to where their targets are in the site, and shows why a block is not run."""
    page.meta.setdefault("search", {"boost": boost(page.file.src_uri)})
    here = posixpath.dirname(page.file.src_uri)
    found = targets(markdown, origin(page.file.src_uri))

    def bent(match: re.Match[str]) -> str:
        path = found.get(match[2])
        return (
            match[0]
            if path is None
            else match[1] + posixpath.relpath(place(path), here or ".") + match[3]
        )

    return NOT_RUN.sub(r"*The tests do not run this block: \1.*\n", LINK.sub(bent, markdown))


def on_post_page(output: str, page, config) -> str:
    """Under `strict` refuses a page that would load something from a network; typesets formulas, names the search."""
    for tag in LOADED.findall(output):
        logging.getLogger("mkdocs.hooks").warning(
            "%s loads from a network: %s", page.file.src_uri, tag
        )
    return formulas.typeset(NAMED.sub(r'\1 aria-label="\3"\2\3', output)).replace(
        'data-md-component="search" role="dialog"',
        'data-md-component="search" role="dialog" aria-label="Search"',
    )
