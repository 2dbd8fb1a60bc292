"""The laboratory: training of the shipped networks, closed-loop flights and their faults, studies.

It imports the product, `drocap_ros`; the product never imports it (`test/test_layout.py`).  It runs from a checkout:
`python -m lab --help`, and the figure pages by `python benchmarks/NAME.py`.
"""
