"""The equations of a model in LaTeX."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from orthaug.data.writing import symbol, tex_text
from orthaug.export.nodes import Apply, Entry, Name, Node, Number
from orthaug.export.program import Block, Program, Signal, Vectors

_FUNCTIONS = {
    "atan": r"\arctan",
    "log": r"\ln",
    "sign": r"\operatorname{sgn}",
    "atan2": r"\operatorname{atan2}",
}
_UPRIGHT = {"expm1", "log1p"}
_INFIX = {"add": (1, "+"), "sub": (1, "-"), "mul": (2, r"\,")}


@dataclass(frozen=True)
class LatexText:
    """`NAME.tex`: equations, constants and networks as a document of its own."""

    summary = "its equations in LaTeX"

    def files(self, program: Program, vectors: Vectors) -> Mapping[str, str]:
        return {f"{program.name}.tex": _document(program)}

    def usage(self, program: Program) -> str:
        return (
            f"`pdflatex {program.name}.tex` makes a page. Each `align` can be copied into a "
            "text of your own; it needs the package amsmath. Numbers have six digits: to "
            "compute with them, export to another target."
        )


def _document(program: Program) -> str:
    head = [
        r"\documentclass{article}",
        r"\usepackage[T1]{fontenc}",
        r"\usepackage{amsmath}",
        r"\setcounter{MaxMatrixCols}{1000}",
    ]
    head.append(f"% Model sha256 {program.digest}")
    lines = [r"\begin{document}"]
    moves = program.scheme is not None
    if program.rate is not None and program.scheme is not None:
        discrete = program.scheme.kind == "discrete"
        left = [
            rf"{_name(signal)}_{{k+1}}" if discrete else rf"\dot{{{_name(signal)}}}"
            for signal in program.states
        ]
        lines += _equations(program.rate, left, program)
    lines += _equations(
        program.output,
        [_name(signal) if moves else f"{_name(signal)}_{{k}}" for signal in program.outputs],
        program,
    )
    lines += [r"\begin{center}", r"\begin{tabular}{lll}"]
    lines += [
        rf"${_constant(c.name, program)}$ & ${number(c.value)}$ & {tex_text(c.meaning)} \\"
        for c in program.constants
    ]
    lines += [r"\end{tabular}", r"\end{center}", r"\end{document}", ""]
    return "\n".join([*head, *_letters("".join(lines)), *lines])


def _name(signal: Signal) -> str:
    return symbol(signal.name)


def _equations(block: Block, left: list[str], program: Program) -> list[str]:
    suffix = "r" if block is program.rate else "y"
    pairs = [
        (_constant(name, program), _latex(node, program, suffix)) for name, node in block.locals
    ]
    pairs += [
        (text, _latex(node, program, suffix))
        for text, node in zip(left, block.results, strict=True)
    ]
    if block.network is not None:
        pairs += [
            (rf"z^{{{suffix}}}_{{{i}}}", _latex(node, program, suffix))
            for i, node in enumerate(block.network.features, start=1)
        ]
        inner = rf"z^{{{suffix}}}"
        for i, layer in enumerate(block.network.layers, start=1):
            bias = "" if layer.bias is None else rf" + b^{{{suffix}}}_{{{i}}}"
            inner = rf"W^{{{suffix}}}_{{{i}}} {inner}{bias}"
            if layer.activation != "identity":
                inner = rf"\operatorname{{{layer.activation}}}\bigl({inner}\bigr)"
        pairs.append((rf"g^{{{suffix}}}", inner))
        for i, layer in enumerate(block.network.layers, start=1):
            pairs.append((rf"W^{{{suffix}}}_{{{i}}}", _matrix(layer.weight)))
            if layer.bias is not None:
                pairs.append((rf"b^{{{suffix}}}_{{{i}}}", _matrix(layer.bias[:, None])))
    body = " \\\\\n".join(f"{a} &= {b}" for a, b in pairs)
    return [r"\begin{align*}", body, r"\end{align*}"]


def _matrix(values: np.ndarray) -> str:
    rows = r" \\ ".join(" & ".join(map(number, row)) for row in values)
    return rf"\begin{{pmatrix}} {rows} \end{{pmatrix}}"


def number(value: float) -> str:
    """Return six digits, with a power of ten where that is shorter."""
    mantissa, _, power = f"{value:.6g}".partition("e")
    return rf"{mantissa} \cdot 10^{{{int(power)}}}" if power else mantissa


def _constant(name: str, program: Program) -> str:
    return symbol(dict(program.symbols)[name])


def _letters(text: str) -> list[str]:
    """Return declarations of Greek letters and the micro sign for pdflatex."""
    lines = []
    for letter in sorted(set(text)):
        kind, _, name = unicodedata.name(letter, "").partition(" LETTER ")
        if letter == "µ":
            kind, name = "GREEK SMALL", "mu"
        if kind in ("GREEK SMALL", "GREEK CAPITAL") and " " not in name:
            written = name.lower() if kind == "GREEK SMALL" else name.capitalize()
            lines.append(
                rf"\DeclareUnicodeCharacter{{{ord(letter):04X}}}{{\ensuremath{{\{written}}}}}"
            )
    return lines


def _entry(node: Entry, program: Program, suffix: str) -> str:
    if node.vector == "g":
        return rf"g^{{{suffix}}}_{{{node.index + 1}}}"
    signal = (program.states if node.vector == "x" else program.inputs)[node.index]
    bare, _, lag = signal.name.partition("[")
    if program.scheme is not None:
        return symbol(bare)
    return f"{symbol(bare)}_{{{lag.rstrip(']') or 'k'}}}"


def _latex(node: Node, program: Program, suffix: str) -> str:
    return _level(node, program, suffix)[1]


def _level(node: Node, program: Program, suffix: str) -> tuple[int, str]:
    if isinstance(node, Number):
        return (0 if node.value < 0 else 9), number(node.value)
    if isinstance(node, Name):
        return 9, _constant(node.name, program)
    if isinstance(node, Entry):
        return 9, _entry(node, program, suffix)
    assert isinstance(node, Apply)

    def within(inner: Node, least: int) -> str:
        level, text = _level(inner, program, suffix)
        return text if level >= least else rf"\left({text}\right)"

    texts = [_latex(argument, program, suffix) for argument in node.arguments]
    if node.function in _INFIX:
        level, sign = _INFIX[node.function]
        left, right = node.arguments
        return level, f"{within(left, level)} {sign} {within(right, level + 1)}"
    if node.function == "div":
        return 9, rf"\frac{{{texts[0]}}}{{{texts[1]}}}"
    if node.function == "neg":
        return 0, f"-{within(node.arguments[0], 2)}"
    if node.function in ("power", "whole_power"):
        exponent = texts[1].removesuffix(".0")
        return 4, f"{within(node.arguments[0], 9)}^{{{exponent}}}"
    if node.function == "sqrt":
        return 9, rf"\sqrt{{{texts[0]}}}"
    if node.function == "abs":
        return 9, rf"\lvert {texts[0]} \rvert"
    name = _FUNCTIONS.get(node.function, rf"\{node.function}")
    name = rf"\operatorname{{{node.function}}}" if node.function in (*_UPRIGHT, "floor") else name
    return 9, rf"{name}\left({', '.join(texts)}\right)"
