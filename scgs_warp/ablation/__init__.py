"""Ablations: one training run per cell of a table, on this machine or on a Ray cluster.

``cells`` defines a cell and runs it, ``local_runner`` and ``ray_runner`` run many, ``table``, ``markdown`` and ``plot``
show the results beside the figures of ``published``.
"""
