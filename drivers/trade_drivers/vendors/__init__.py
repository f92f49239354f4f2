"""One folder for each vendor's protocol, with the same file names in each, as far as it has these parts.

``_table`` has the registers and models as data, ``_wire`` makes and reads the bytes, ``_axis`` has a joint's state,
``_exchange`` runs the cycles and jobs of a bus, ``_driver`` attaches, checks, scans and sets devices up. ``_frames``
replaces ``_wire`` where a CAN adapter has the line. CiA 402 and UR have further files.
"""
