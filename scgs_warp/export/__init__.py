"""Files that other programs open: one Python file per family of formats, described in ``docs/formats.md``.

:func:`scgs_warp.export.run.export` writes what a :class:`~scgs_warp.export.request.ExportRequest` asks for.
"""
