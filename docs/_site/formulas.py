"""Formulas as they are in the Markdown, `θ̂ = R⁻¹QᵀY` or y_k, typeset as MathML: browsers draw it, without a script.

The Markdown stays text that is read in the repository. Code that is a formula, lines of formulas, and letters with an
index in prose are found in the finished page; whatever else is code stays code.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from html import escape, unescape

_RAISED = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻ᵀᴺᴴᵐⁿ", "0123456789+−TNHmn", strict=True))
_LOWERED = dict(zip("₀₁₂₃₄₅₆₇₈₉", "0123456789", strict=True))
_ACCENTS = {"\u0302": "^", "\u0303": "~", "\u0304": "¯", "\u0307": "˙"}
_WORDS = ("tr", "ln", "Ts")  # names of two letters; other pairs are products
_GREEK = "Α-Ωα-ω"
_MARK = re.compile(
    rf"[{_GREEK}{''.join(_RAISED)}{''.join(_LOWERED)}{''.join(_ACCENTS)}‖√∂⊥ŷẋŶ]|[A-Za-z]_\{{"
)
_CODE = re.compile(
    r"[\"`]|\w\[|[A-Za-z]\.\w|[a-z]{2}[A-Z]|\w\(\w+=|[a-z0-9]{2,}_[a-z]{2,}|//|==|→|\w{2,}\*\w|\*\*"
)
_PROSE = re.compile(r"[A-Za-z]{3,}[ ,]+[A-Za-z]{2,}")
_LETTERS = rf"A-Za-z{_GREEK}𝕏ŷŶẋ"
_INDEX = rf"[_^](?:\{{[^{{}}]*\}}|[{_GREEK}]?[A-Za-z0-9*]{{0,4}}(?![A-Za-z0-9_]))"
_INDEXED = re.compile(
    rf"(?<![A-Za-z0-9_/.])[{_LETTERS}][{''.join(_ACCENTS)}]?{_INDEX}[{''.join(_RAISED)}*]*"
)
_RUN = rf"(?:[{_LETTERS}0-9()\[\]|‖*'/·√∂∫⊥{''.join(_RAISED)}{''.join(_LOWERED)}{''.join(_ACCENTS)}]|{_INDEX})+"
_SUM = re.compile(rf"(?<![\w/.]){_RUN}(?:\s[=+−·≤≥≈→]\s{_RUN})*(?![\w.]\w)")
_NAME = re.compile(r"[a-z]{2,}(?:_[a-z]{2,})+")  # of code, as in a heading
_TOKEN = re.compile(
    rf"(?P<space>\s+)|(?P<number>\d+(?:\.\d+)?)|(?P<raised>[{''.join(_RAISED)}]+)|(?P<lowered>[{''.join(_LOWERED)}]+)"
    rf"|(?P<index>[_^](?:\{{[^{{}}]*\}}|\([^()]*\)|[{_GREEK}][a-z]*|[A-Z]+|[a-z0-9]+))"
    rf"|(?P<word>[A-Za-z]{{3,}}|(?:{'|'.join(_WORDS)})(?![A-Za-z]))|(?P<letter>[^\W\d_])(?P<accent>[{''.join(_ACCENTS)}])?"
    r"|(?P<star>(?<=\w)\*(?=[\s)]|$)|⊥|')|(?P<other>.)",
    re.DOTALL,
)
_PART = re.compile(
    r"<pre\b.*?</pre>|<code>[^<]*</code>|<(?:script|style|svg|math|title)\b.*?</(?:script|style|svg|math|title)>|<code\b.*?</code>"
    r"|<[^>]+>",
    re.DOTALL,
)
_LINES = re.compile(r"<pre\b[^>]*>(?:<span></span>)?<code[^>]*>(.*)</code></pre>", re.DOTALL)


@dataclass
class _Atom:
    base: str
    below: str = ""
    above: str = ""

    def __str__(self) -> str:
        if self.below and self.above:
            return f"<msubsup>{self.base}{self.below}{self.above}</msubsup>"
        if self.below or self.above:
            tag = "msub" if self.below else "msup"
            return f"<{tag}>{self.base}{self.below}{self.above}</{tag}>"
        return self.base


def rows(text: str) -> str:
    """The elements of a formula, in one row."""
    atoms: list[_Atom] = []
    for match in _TOKEN.finditer(_apart(text)):
        kind, found = match.lastgroup, match[0]
        if match["letter"]:
            atoms.append(_Atom(_letter(match["letter"], match["accent"])))
        elif kind == "word":
            atoms.append(_Atom(f"<mi>{found}</mi>"))
        elif kind == "number":
            atoms.append(_Atom(f"<mn>{found}</mn>"))
        elif kind == "space":
            continue
        elif kind == "other" or not atoms:
            stretchy = ' stretchy="false"' if found in "()[]|‖{}⌈⌉" else ""
            atoms.append(_Atom(f"<mo{stretchy}>{escape(found)}</mo>"))
        elif kind in ("lowered", "index") and not found.startswith("^"):
            inner = "".join(_LOWERED.get(letter, letter) for letter in found)
            atoms[-1].below += _row(inner.lstrip("_"))
        else:
            inner = "".join(_RAISED.get(letter, letter) for letter in found).replace("'", "′")
            above = _row(inner.lstrip("^"))
            atoms[-1].above = f"<mrow>{atoms[-1].above}{above}</mrow>" if atoms[-1].above else above
    return "".join(map(str, atoms))


def _apart(text: str) -> str:
    """Accents apart from their letters, as marks behind them."""
    return "".join(
        unicodedata.normalize("NFD", letter) if letter in "ŷŶẋẏx̂" else letter for letter in text
    )


def _letter(letter: str, accent: str | None) -> str:
    plain = f"<mi>{letter}</mi>"
    return f'<mover accent="true">{plain}<mo>{_ACCENTS[accent]}</mo></mover>' if accent else plain


def _row(text: str) -> str:
    inner = text[1:-1] if text[:1] + text[-1:] in ("{}", "()") else text
    if re.fullmatch(r"[a-z]{2,}|[A-Z]{2,}|T", inner):  # a name, or transposed
        return f'<mi mathvariant="normal">{inner}</mi>'
    return f"<mrow>{rows(inner)}</mrow>"


def mathml(text: str, *, display: bool = False) -> str:
    """A formula as an element of its own."""
    block = ' display="block"' if display else ""
    return f"<math{block}>{rows(text)}</math>"


def is_formula(text: str) -> bool:
    """Whether code is a formula and nothing that is typed."""
    return bool(_MARK.search(text)) and not _CODE.search(text) and not _PROSE.search(text)


def typeset(page: str) -> str:
    """A page with its formulas typeset; what lies outside of the article stays."""
    begin, end = page.find("<article"), page.rfind("</article>")
    if begin < 0 or end < 0:
        return page
    made, place = [page[:begin]], begin
    for match in _PART.finditer(page, begin, end):
        made += [_prose(page[place : match.start()]), _part(match[0])]
        place = match.end()
    return "".join([*made, _prose(page[place:end]), page[end:]])


def _part(part: str) -> str:
    if part.startswith("<code>"):
        text = unescape(part[len("<code>") : -len("</code>")])
        return mathml(text) if is_formula(text) else part
    lines = _LINES.fullmatch(part)
    text = unescape(re.sub(r"<[^>]+>", "", lines[1])).strip("\n") if lines else ""
    if text and all(is_formula(line) and "=" in line for line in text.splitlines()):
        return "".join(mathml(line.strip(), display=True) for line in text.splitlines())
    return part


def _prose(text: str) -> str:
    """Runs of symbols as a whole; where words are among them, letters with an index alone."""
    return _SUM.sub(_run, text)


def _run(match: re.Match[str]) -> str:
    run = match[0]
    if _NAME.fullmatch(run) or not re.search(
        rf"{_INDEX}|[{_GREEK}].*[{''.join(_RAISED)}{''.join(_ACCENTS)}]", run
    ):
        return run
    bare = re.sub(_INDEX, "", run)
    if re.search(r"[A-Za-z]{3,}|[*]{2}", bare) or any(
        run.count(a) != run.count(b) for a, b in ("()", "[]")
    ):
        return _INDEXED.sub(lambda one: mathml(one[0]), run)
    return mathml(run)
