"""Markdown tables and their numbers."""

from __future__ import annotations


def table(head: list[str], lines: list[list[str]], numbers: bool = True) -> str:
    """Write a Markdown table: the first column to the left, and the others to the right if they hold numbers."""
    rule = ["---"] + ["---:" if numbers else "---"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, rule, *lines])


def number(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:,.{digits}f}"


def duration(seconds: float | None) -> str:
    """Write a duration as ``3 min 22 s``, from an hour on as ``1 h 30 min``."""
    if seconds is None:
        return ""
    if seconds >= 3600:
        minutes = round(seconds / 60)
        return f"{minutes // 60} h {minutes % 60} min"
    whole = round(seconds)
    return f"{whole // 60} min" + (f" {whole % 60} s" if whole % 60 else "")


def thousands(count: float | None, digits: int = 0) -> str:
    return "" if count is None else f"{count / 1000:.{digits}f}k"


def signed(value: float | None) -> str:
    return "" if value is None else f"{value:+.2f}"


def percent(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f} %"
