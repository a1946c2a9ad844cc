"""What `orthaug fit` and `orthaug compare` do, from Python: specs opened, fitted and compared."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from orthaug._base.checks import check_type
from orthaug._base.errors import InputError
from orthaug.commands.folder import check_folder, check_inputs_kept
from orthaug.commands.job import Job
from orthaug.commands.kinds import open_job

if TYPE_CHECKING:
    from orthaug.commands.compare import Comparison
    from orthaug.commands.fit import Fitted

Spec = str | os.PathLike | Job


def load_spec(path: str | os.PathLike) -> Job:
    """Read a spec and all its data, and check them against each other; nothing is trained.

    Args:
        path: of the spec, a TOML file; paths in it start at its folder.

    Returns:
        What `fit_spec` and `compare` take. `train.record`, `validation` and `tests` are its data, `problem` the rows
        with the physics, `spec` the declarations.

    Raises:
        InputError: anything wrong with spec, files or physics; one line that names it.
    """
    check_type(path, str | os.PathLike, "path", "the name of a spec file")
    return open_job(Path(path))


def fit_spec(spec: Spec, out: str | os.PathLike | None = None) -> Fitted:
    """What `orthaug fit` does: train, score every part, and ask whether the learner earns its place.

    Args:
        spec: a spec file, or what `load_spec` returned.
        out: folder to write result, model, figures and report into; None to write nothing.

    Returns:
        `fit`, the `Estimate`; `result`, the content of result.json; `summary()`, what the command prints. Where
        training failed numerically `fit.status` says so, and there are no scores.

    Raises:
        InputError: as `load_spec`; a folder that cannot be written or holds something else.
    """
    job, folder = _opened(spec, out)
    from orthaug.commands.fit import fit_job, write_result

    fitted = fit_job(job)
    if folder is not None:
        write_result(fitted, folder)
    return fitted


def compare(spec: Spec, models: Sequence[str | os.PathLike] = (), out: str | os.PathLike | None = None) -> Comparison:
    """What `orthaug compare` does: physics alone and every structure on the same data and seeds.

    Args:
        spec: a spec file, or what `load_spec` returned.
        models: folders of saved models to put beside.
        out: folder to write result, models and figure into; None to write nothing.

    Returns:
        `fitted`, one `Fitted` by the name of the structure; `verdicts`, whether the learner helps in each; `result`,
        the content of result.json; `summary()`, what the command prints.

    Raises:
        InputError: as `fit_spec`; a model that does not fit the data.
    """
    if isinstance(models, str | os.PathLike) or not isinstance(models, Sequence):
        raise InputError("`models` must be a list of folders, such as ['orthaug-out/spec'].")
    for model in models:
        check_type(model, str | os.PathLike, "models", "a list of folders")
    job, folder = _opened(spec, out)
    from orthaug.commands import compare as comparing

    comparison = comparing.compare(job, [Path(model) for model in models])
    if folder is not None:
        comparing.write(comparison, folder)
    return comparison


def _opened(spec: Spec, out: str | os.PathLike | None) -> tuple[Job, Path | None]:
    """The job, and the folder to write, checked."""
    check_type(spec, Spec, "spec", "the name of a spec file, or what load_spec returns")
    check_type(out, str | os.PathLike | None, "out", "the name of a folder, or None")
    folder = None if out is None else Path(out)
    if folder is not None:
        check_folder(folder)
    job = spec if isinstance(spec, Job) else open_job(Path(spec))
    if folder is not None:
        check_inputs_kept(job, folder)
    return job, folder
