"""The learners that a spec knows by name.

A new one is a file with its declaration, and an entry here.
"""

from __future__ import annotations

from orthaug._base import plugins
from orthaug._base.registry import Registry
from orthaug.models.learners import MLP, NoLearner
from orthaug.models.terms import Terms

LEARNERS = Registry(
    "learner",
    {"mlp": MLP, "terms": Terms, "none": NoLearner},
    reserved=("kind", "nz", "ny"),
    group=plugins.LEARNERS,
)
"""`nz` and `ny` are saved next to a learner's own fields."""
