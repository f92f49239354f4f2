"""One folder for each vendor's protocol, with the same file names in each.

``_driver`` attaches, ``_inspect`` checks, ``_axis`` has a joint's state, ``_cycle`` and ``_jobs`` use the bus,
``_frames``, ``_table`` and ``_wire`` implement the protocol, ``_commission`` and ``_scan`` find devices.
"""
