"""orthaug: models of physics and a learned correction that share no directions of θ.

Names load on first use, so that `orthaug --help` and reading data do not import JAX; `__init__.pyi`
lists them.
"""

from typing import Any

import lazy_loader

from orthaug._base.views import MAKERS

__version__ = "0.1.0"
_COLUMNS = 80  # of findings that are printed


def _html(shown: Any) -> str:
    from orthaug.reports.html import html_of

    return html_of(shown)


def _plot(fit: Any) -> Any:
    from orthaug.reports.figures import FitPlots

    return FitPlots(fit)


def _report(fit: Any, path: Any, tests: Any) -> Any:
    from orthaug.commands.library import page_of, page_of_spec

    return (page_of_spec if hasattr(fit, "job") else page_of)(fit, path, tests)


def _diagnose(fit: Any, **asked: Any) -> Any:
    from orthaug.analysis.evidence import Evidence
    from orthaug.analysis.examination import examine

    return examine(fit, Evidence.of(fit, **asked)).findings


def _findings(fit: Any, findings: Any, *, html: bool) -> str:
    from orthaug._base.lines import narrow_screen
    from orthaug.reports.html import card_of_result, html_of
    from orthaug.reports.text import fit_text

    if html:
        return html_of(card_of_result(fit, findings))
    with narrow_screen(_COLUMNS):
        return fit_text(fit, findings) or fit.status.message


def _verdict(findings: Any) -> str:
    from orthaug.reports.page_verdict import fit_verdict

    if not findings.scores:  # training failed
        return f"Do not use the model: {findings.status.message}"
    verdict = fit_verdict(findings)
    return f"{verdict.trust} {verdict.use}"


def _intervals(fit: Any, *, ordered: bool = True) -> Any:
    from orthaug.analysis.robustness import with_suited_errors

    return with_suited_errors(fit, ordered=ordered)


def _progress() -> Any:
    from orthaug.commands.bars import shown_progress

    return shown_progress()


MAKERS.update(html=_html, plot=_plot, report=_report, progress=_progress)
MAKERS.update(diagnose=_diagnose, findings=_findings, verdict=_verdict, intervals=_intervals)

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in __all__ or name.startswith("_"):
        return _load(name)
    from orthaug._base.checks import nearest

    raise AttributeError(
        f"module 'orthaug' has no attribute '{name}'{nearest(name, __all__) or '.'}"
    )
