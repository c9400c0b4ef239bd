"""Parts of a scene for a page on which visitors pull them: joints, chains, and the graph that bends between them."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..edit import EditSession
from .page_data import Column, integers, quantise
from .page_parts import part_facts
from .page_scene import STEPS, PageMotion


def posable(session: EditSession, motion: PageMotion) -> PageMotion:
    """Add the parts of the session's skeleton to a page's motion, for visitors to pull."""
    engine = session.engine
    poser = engine.poser(session.skeleton)
    skeleton, rows = poser.skeleton, poser.rows
    edges = poser.graph.edges
    columns: list[Column] = [integers("part", poser.owner)]
    columns += [quantise(f"start{a}", poser.start[:, a], STEPS["rest"]) for a in range(3)]
    columns += [integers(f"edge{end}", edges[:, end] if len(edges) else np.zeros(0, np.int64)) for end in range(2)]
    chains = [[rows[name] for name in skeleton.chain(part.name)] for part in skeleton.parts]
    facts = {
        **motion.facts,
        "edited": True,
        "parts": part_facts(skeleton, session.scene.normalisation),
        "pose": {"edge_length": poser.graph.edge_length, "chains": chains},
    }
    return dataclasses.replace(motion, facts=facts, columns=[*motion.columns, *columns])
