"""The measurements of ``benchmark.py``, one module for each."""
