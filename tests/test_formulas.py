"""Formulas of the documents are typeset on the site; what is typed, names and printed lines stay as they are."""

from __future__ import annotations

import importlib.util
import re
import sys
from xml.etree import ElementTree

import pytest
from documents import ROOT, pages

SPEC = importlib.util.spec_from_file_location("formulas", ROOT / "docs" / "_site" / "formulas.py")
assert SPEC is not None and SPEC.loader is not None
formulas = sys.modules["formulas"] = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(formulas)


@pytest.mark.parametrize(
    ("text", "made"),
    [
        ("y_k", "<msub><mi>y</mi><mrow><mi>k</mi></mrow></msub>"),
        ("θ_aux", '<msub><mi>θ</mi><mi mathvariant="normal">aux</mi></msub>'),
        ("x_{k+1}", "<msub><mi>x</mi><mrow><mi>k</mi><mo>+</mo><mn>1</mn></mrow></msub>"),
        ("ŷ", '<mover accent="true"><mi>y</mi><mo>^</mo></mover>'),
        ("θ̂", '<mover accent="true"><mi>θ</mi><mo>^</mo></mover>'),
        ("ẋ", '<mover accent="true"><mi>x</mi><mo>˙</mo></mover>'),
        ("R⁻¹", "<msup><mi>R</mi><mrow><mo>−</mo><mn>1</mn></mrow></msup>"),
        ("Φ_μ⁺", "<msubsup><mi>Φ</mi><mrow><mi>μ</mi></mrow><mrow><mo>+</mo></mrow></msubsup>"),
        ("Φ_μB", "<msub><mi>Φ</mi><mrow><mi>μ</mi></mrow></msub><mi>B</mi>"),
        ("θ₁u", "<msub><mi>θ</mi><mrow><mn>1</mn></mrow></msub><mi>u</mi>"),
        ("a < b", "<mi>a</mi><mo>&lt;</mo><mi>b</mi>"),
    ],
)
def test_symbols(text, made):
    assert formulas.rows(text) == made


@pytest.mark.parametrize(
    "text", ["θ̂ = R⁻¹QᵀY", "ΦᵀΦ", "S_k = G_k + Σ A_{k,i} S_{k−i}", "‖Y − Φθ − P⊥F‖²", "s²(ΦᵀΦ)⁻¹"]
)
def test_code_that_is_a_formula(text):
    assert formulas.typeset(f"<article><p><code>{text}</code></p></article>").count("<math>") == 1


@pytest.mark.parametrize(
    "text",
    [
        "y[k-1]",
        "theta_aux",
        "estimate(λ=1)",
        "BaselinePenalty(λ)",
        "θ is split off along them",
        '"θ"',
        "model.θ_aux",
    ],
)
def test_code_that_is_typed_stays(text):
    page = f"<article><p><code>{text}</code></p></article>"
    assert formulas.typeset(page) == page


def test_prose():
    made = formulas.typeset("<article><td>ŷ_k = φ(x_k)θ_b, the physics</td></article>")
    assert made.count("<math>") == 1 and made.endswith("</math>, the physics</td></article>")
    for text in (
        "at_most",
        "no_help of it",
        "X (n_samples, n_features) and noise_std_",
        "a file train_k.csv",
        "10 %, then",
        "y_k outside",
    ):
        page = (
            f"<article>{text}</article>"
            if text != "y_k outside"
            else f"<nav>{text}</nav><article></article>"
        )
        assert formulas.typeset(page) == page


def test_lines_of_formulas_and_printed_lines():
    block = (
        '<article><div class="highlight"><pre><span></span><code>{}\n</code></pre></div></article>'
    )
    assert 'display="block"' in formulas.typeset(block.format("‖Y − Ŷ‖² = ‖QᵀY − Rθ‖²"))
    printed = block.format("100 % of what the learner found = θ̂ of it")
    assert formulas.typeset(printed) == printed


def test_every_formula_of_the_documents_is_well_formed():
    found = 0
    for page in pages():
        prose = re.sub(
            r"^ *```.*?^ *```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
        )
        for text in re.findall(r"`([^`\n]+)`", prose):
            if formulas.is_formula(text):
                made = ElementTree.fromstring(formulas.mathml(text))
                symbols = "".join(made.itertext())
                assert not set("_{}") & set(symbols), (page.name, text)
                found += 1
    assert found > 60
