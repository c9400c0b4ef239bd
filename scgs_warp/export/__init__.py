"""Writers of files that other programs open, one module per family of formats; ``docs/formats.md`` describes them.

:func:`scgs_warp.export.run.export` carries out an :class:`~scgs_warp.export.request.ExportRequest`.
"""
