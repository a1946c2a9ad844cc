"""Public data sets in their protocols, as declared in sets/: specs, published figures, verdicts."""

from __future__ import annotations

import glob
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from orthaug._base.checks import nearest
from orthaug._base.errors import InputError
from orthaug.data.channels import Channel
from orthaug.reports.benchmark import (
    BenchmarkModelResult,
    ErrorResult,
    FitKind,
    PublishedResult,
    SetResult,
    VerdictCode,
    VerdictResult,
)

DECLARED: FitKind = "declared"
DEFAULT: FitKind = "default"
PHYSICS: FitKind = "physics alone"
_CHOSEN = ("lags", "learner", "structure", "training", "validation", "noise", "selection")
"""Sections of a spec that `default` leaves out: all that is chosen beyond data and physics."""


@dataclass(frozen=True)
class PublicSet:
    """A set with its files, tests and models; `content` is its declaration."""

    name: str
    content: Mapping[str, Any]

    @property
    def title(self) -> str:
        """The name of the set in words."""
        return self.content["title"]

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models; the first is entered against published figures."""
        return tuple(model["name"] for model in self.content["models"])

    @property
    def published(self) -> list[PublishedResult]:
        """Published figures by the same protocol."""
        return [PublishedResult.model_validate(one) for one in self.content.get("published", ())]

    @property
    def unit(self) -> str | None:
        """Unit of the errors, by default that of the only output; None for those of several."""
        data = self.content["data"]
        outputs, channels = data["outputs"], data.get("channels", {})
        only = channels.get(outputs[0], {}).get("unit") if len(outputs) == 1 else None
        return self.content.get("unit", only)

    def spec(
        self, model: str, *, default: bool = False, folder: Path | None = None
    ) -> dict[str, Any]:
        """Return the spec of a model, its files relative to the folder of the data.

        Args:
            default: leave out all that is chosen beyond the physics.
            folder: of the data, to be put before the names of the files.
        """
        sections = next(one for one in self.content["models"] if one["name"] == model)
        left_out = ("name", *(_CHOSEN if default else ()))
        spec = {"data": self.content["data"]} | {
            key: value for key, value in sections.items() if key not in left_out
        }
        return spec if folder is None else _in_folder(spec, folder)

    def options(self, package: str) -> Mapping[str, Any] | None:
        """Return the options of another package on this set; None where it is not compared."""
        return self.content.get("beside", {}).get(package)

    def missing(self, folder: Path) -> str | None:
        """Return the first file or pattern of the set that the folder lacks; None for none."""
        for name in dict.fromkeys(self._files()):
            if not glob.glob(glob.escape(str(folder)) + "/" + name):
                return name
        return None

    def _files(self) -> Iterator[str]:
        data = self.content["data"]
        parts = (data["train"], data.get("validation", {}), *data.get("tests", {}).values())
        for part in parts:
            yield from part.get("files", ())

    def errors_of(self, test: str, outputs: Sequence[Channel], rmse: Sequence[Any]) -> list[Any]:
        """Return the RMSE of each output on a test, in the set's unit.

        Args:
            rmse: in the outputs' units; None or not finite where a run diverged.
        """
        scale = self.content.get("scale", 1.0)
        return [
            ErrorResult(
                test=test,
                output=channel.name,
                unit=self.unit or channel.unit,
                rmse=None if value is None else scale * float(value),
            )
            for channel, value in zip(outputs, rmse, strict=True)
        ]

    def result(self, text: str = "", **measured: Any) -> SetResult:
        """Return the content of a result: the declaration with what was measured."""
        own = {"name": self.name} | {key: self.content[key] for key in ("title", "source")}
        empty: dict[str, Any] = {"data": None, "models": [], "beside": []}
        found = empty | measured
        entered = next((m for m in found["models"] if m.fit == DECLARED), None)
        verdicts = list(self._verdicts(entered))
        return SetResult(
            **own,
            protocol=self.content["protocol"],
            text=text,
            published=self.published,
            verdicts=verdicts,
            verdict=None if entered is None else _together(verdicts),
            **found,
        )

    def _verdicts(self, entered: BenchmarkModelResult | None) -> Iterator[VerdictResult]:
        """Yield the entered model against the best published one, for each test.

        A test of several outputs has no published figure.
        """
        for test in self.content["data"].get("tests", {}):
            own = [e for e in entered.errors if e.test == test] if entered else []
            figures = {
                one.model: rmse
                for one in self.published
                if (rmse := one.errors.get(test)) is not None
            }
            best = min(figures, key=lambda name: figures[name], default=None)
            ours = own[0].rmse if len(own) == 1 else None
            limit = None if best is None else figures[best]
            verdict: VerdictCode | None = None  # of a set that was not measured
            if limit is None:
                verdict = "no published figure"
            elif entered is not None:
                verdict = "ahead" if ours is not None and ours < limit else "behind"
            yield VerdictResult(
                test=test,
                unit=self.unit or (own[0].unit if own else ""),
                ours=ours,
                published=limit,
                by=best,
                verdict=verdict,
            )


def _in_folder(section: Any, folder: Path) -> Any:
    """Return a section with a folder before the names in every `files` of it."""
    if not isinstance(section, Mapping):
        return section
    return {
        key: [(folder / name).as_posix() for name in value]
        if key == "files"
        else _in_folder(value, folder)
        for key, value in section.items()
    }


def _together(verdicts: Sequence[VerdictResult]) -> Any:
    """Return the verdict on a set: behind where it is behind on one test."""
    codes = {verdict.verdict for verdict in verdicts} - {"no published figure"}
    return "behind" if "behind" in codes else "ahead" if codes else "no published figure"


@cache
def public_sets() -> dict[str, PublicSet]:
    """Return the sets by name, in alphabetical order."""
    folder = files("orthaug.studies").joinpath("sets")
    texts = {
        place.name.removesuffix(".toml"): place.read_text(encoding="utf-8")
        for place in folder.iterdir()
        if place.name.endswith(".toml")
    }
    return {name: PublicSet(name, tomllib.loads(texts[name])) for name in sorted(texts)}


def choose_sets(names: Sequence[str]) -> list[PublicSet]:
    """Return sets by their names, all where none is given.

    Raises:
        InputError: no set of that name.
    """
    known = public_sets()
    for name in names:
        if name not in known:
            raise InputError(
                f"there is no set '{name}'{nearest(name, known) or '.'} "
                f"There are {', '.join(known)}."
            )
    return [known[name] for name in dict.fromkeys(names or known)]
