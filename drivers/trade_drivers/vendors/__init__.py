"""One folder for each vendor's protocol, with the same file names in each.

``_table`` has the registers and models as data, ``_wire`` makes and reads the bytes, ``_axis`` has a joint's state,
``_exchange`` runs the cycles and jobs of a bus, ``_driver`` attaches, checks, scans and sets devices up.
"""
