"""Films of a built-in subject in a furnished room, as a phone or a rig of cameras would take them, with their truth."""

from __future__ import annotations

from .film import FilmPlan, make_film, plan_film
from .request import FILM_KINDS, FilmKind, FilmRequest

__all__ = ["FILM_KINDS", "FilmKind", "FilmPlan", "FilmRequest", "make_film", "plan_film"]
