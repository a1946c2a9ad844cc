"""Units and LaTeX of expressions."""

from __future__ import annotations

import ast
import unicodedata
from collections import Counter
from collections.abc import Mapping
from fractions import Fraction

from orthaug.data.expressions import Expression

# Of numbers without unit
_PLAIN = ("sign", "tanh", "sin", "cos", "tan", "atan", "atan2", "exp", "log", "floor")
_SAME = ("abs", "min", "max")
_LATEX = {
    "sin": r"\sin",
    "cos": r"\cos",
    "tan": r"\tan",
    "atan": r"\arctan",
    "exp": r"\exp",
    "log": r"\ln",
}
_LATEX |= {"tanh": r"\tanh", "sign": r"\operatorname{sgn}", "min": r"\min", "max": r"\max"}
Unit = Counter[str]
"""Powers by the name of a unit."""


def coefficient_unit(unit: str, term: Expression, units: Mapping[str, str]) -> str | None:
    """Return the unit of a term's coefficient; None where a unit is missing.

    The sum has `unit`; channels and states have theirs.

    Examples:
        >>> from orthaug.data.expressions import parse
        >>> coefficient_unit("N", parse("v[k-1]*abs(x[k-1])"), {"v": "m/s", "x": "m"})
        'N/((m/s)*m)'
        >>> coefficient_unit("bar/s", parse("p[k-1]*valve[k-1]"), {"p": "bar", "valve": "1"})
        '1/s'
    """
    found = _unit(term.tree, units)
    if found is None or (found and not unit):
        return None
    powers = Counter({unit: 1} if unit else {})
    powers.subtract(found)
    powers = _cancelled(powers)
    above = [_power(name, power) for name, power in powers.items() if power > 0]
    below = [_power(name, -power) for name, power in powers.items() if power < 0]
    if not below:
        return unit if powers == Counter({unit: 1}) else "*".join(above)
    under = f"({'*'.join(below)})" if len(below) > 1 else below[0]
    return f"{'*'.join(above) or '1'}/{under}"


def latex(expression: Expression) -> str:
    r"""Return the expression as LaTeX, lags as indices.

    Examples:
        >>> from orthaug.data.expressions import parse
        >>> latex(parse("sign(v[k-1])*v[k-1]**2/2"))
        '\\frac{\\operatorname{sgn}(v_{k-1})\\,v_{k-1}^{2}}{2}'
    """
    return _latex(expression.tree)


def _unit(node: ast.AST, units: Mapping[str, str]) -> Unit | None:
    if isinstance(node, ast.Constant):
        return Counter()
    if isinstance(node, ast.Name | ast.Subscript):
        name = node.id if isinstance(node, ast.Name) else getattr(node.value, "id", "")
        unit = units.get(name)
        return None if not unit else Counter({unit: 1} if unit != "1" else {})
    if isinstance(node, ast.UnaryOp):
        return _unit(node.operand, units)
    if isinstance(node, ast.Call):
        name = getattr(node.func, "id", "")
        inner = [_unit(argument, units) for argument in node.args]
        if name in _SAME:
            return inner[0] if all(other == inner[0] for other in inner) else None
        if name == "sqrt" and inner[0] is not None:
            return Counter({unit: Fraction(power, 2) for unit, power in inner[0].items()})  # type: ignore[dict-item]
        return Counter() if name in _PLAIN else None
    if not isinstance(node, ast.BinOp):
        return None
    left, right = _unit(node.left, units), _unit(node.right, units)
    if left is None or right is None:
        return None
    if isinstance(node.op, ast.Add | ast.Sub):
        return left if left == right else None
    if isinstance(node.op, ast.Pow):
        if not isinstance(node.right, ast.Constant):
            return None
        return Counter({unit: power * node.right.value for unit, power in left.items()})  # type: ignore[operator]
    sign = 1 if isinstance(node.op, ast.Mult) else -1
    together = {unit: left[unit] + sign * right[unit] for unit in left | right}
    return Counter({unit: power for unit, power in together.items() if power})


def _cancelled(powers: Unit) -> Unit:
    """Return powers of the parts of compound units, such as bar/s, where some of them cancel."""
    parts: Unit = Counter()
    for unit, power in powers.items():
        for part, own in _parts(unit).items():
            parts[part] += own * power
    apart = sum(abs(own * power) for u, power in powers.items() for own in _parts(u).values())
    cancels = sum(map(abs, parts.values())) < apart
    return Counter({part: power for part, power in parts.items() if power}) if cancels else powers


def _parts(unit: str) -> Unit:
    """Return the parts of a unit with one stroke at most; others are their own only part."""
    above, _, below = unit.partition("/")
    if any(mark in above for mark in "()^") or not below.isalnum():
        return Counter({unit: 1})
    parts: Unit = Counter()
    for part in above.replace("*", " ").split():
        if part != "1":
            name, power = _base(part)
            parts[name] += power
    name, power = _base(below)
    parts[name] -= power
    return parts


def _base(part: str) -> tuple[str, int]:
    """Return a unit's name and power: s and 2 of s² and of s2."""
    name, last = part[:-1], part[-1]
    return (name, int(unicodedata.normalize("NFKC", last))) if last in "²³23" else (part, 1)


def _power(name: str, power: object) -> str:
    closed = f"({name})" if any(mark in name for mark in "/* ") else name
    return closed if power == 1 else f"{closed}**{power}"


def _latex(node: ast.AST) -> str:
    if isinstance(node, ast.Constant):
        return f"{node.value:g}" if isinstance(node.value, int | float) else str(node.value)
    if isinstance(node, ast.Name):
        return symbol(node.id)
    if isinstance(node, ast.Subscript):
        return symbol(getattr(node.value, "id", ""), ast.unparse(node.slice).replace(" ", ""))
    if isinstance(node, ast.UnaryOp):
        return ("-" if isinstance(node.op, ast.USub) else "") + _tight(node.operand)
    if isinstance(node, ast.Call):
        name, inner = getattr(node.func, "id", ""), ", ".join(map(_latex, node.args))
        if name == "sqrt":
            return rf"\sqrt{{{inner}}}"
        if name == "abs":
            return rf"\lvert {inner} \rvert"
        written = _LATEX.get(name) or rf"\operatorname{{{name}}}"
        return f"{written}({inner})"
    assert isinstance(node, ast.BinOp)
    if isinstance(node.op, ast.Div):
        return rf"\frac{{{_latex(node.left)}}}{{{_latex(node.right)}}}"
    if isinstance(node.op, ast.Pow):
        base = (
            _latex(node.left)
            if isinstance(node.left, ast.Name | ast.Subscript)
            else f"({_latex(node.left)})"
        )
        return f"{base}^{{{_latex(node.right)}}}"
    if isinstance(node.op, ast.Mult):
        return rf"{_tight(node.left)}\,{_tight(node.right)}"
    right = _tight(node.right) if isinstance(node.op, ast.Sub) else _latex(node.right)
    return f"{_latex(node.left)} {'+' if isinstance(node.op, ast.Add) else '-'} {right}"


def _tight(node: ast.AST) -> str:
    """Return LaTeX in brackets where it is a sum."""
    loose = isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub)
    return f"({_latex(node)})" if loose else _latex(node)


_TEX = {
    **{letter: rf"\{letter}" for letter in "_%&#${}"},
    **{
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "<": r"\textless{}",
    },
    **{
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        '"': r"\textquotedbl{}",
        "`": r"\textasciigrave{}",
    },
}


def tex_text(text: str) -> str:
    r"""Return plain text for TeX: no letter of it begins a command, a group or a comment.

    Examples:
        >>> print(tex_text(r"50 % of \input{x}"))
        50 \% of \textbackslash{}input\{x\}
    """
    return "".join(_TEX.get(letter, letter if letter.isprintable() else " ") for letter in text)


def symbol(name: str, index: str = "") -> str:
    """Return a name in LaTeX: letters, digits behind one letter as an index, words upright."""
    letters = name.rstrip("0123456789")
    if len(letters) == 1:
        base, below = letters, ",".join(filter(None, (name[1:], index)))
    else:
        upright = tex_text(name)
        base, below = rf"\mathrm{{{upright}}}", index
    return f"{base}_{{{below}}}" if below else base
