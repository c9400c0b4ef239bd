"""Readers of data sets, one file per layout: ``recognises`` and ``read``. ``data/__init__.py`` lists them in
``READERS``; they return what ``data/assemble.py`` builds."""
