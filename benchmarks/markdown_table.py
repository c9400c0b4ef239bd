"""Markdown tables and their numbers."""

from __future__ import annotations


def table(head: list[str], lines: list[list[str]], numbers: bool = True) -> str:
    """Write a Markdown table: the first column to the left, and the others to the right if they hold numbers."""
    rule = ["---"] + ["---:" if numbers else "---"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, rule, *lines])


def number(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:,.{digits}f}"
