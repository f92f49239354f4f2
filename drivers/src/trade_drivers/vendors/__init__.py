"""One folder a vendor's protocol. Each has the same files under the same names.

``_driver`` attaches, ``_inspect`` checks, ``_axis`` keeps a joint's state, ``_cycle`` and ``_jobs`` use the bus,
``_frames``, ``_table`` and ``_wire`` are the protocol, ``_commission`` and ``_scan`` find devices.
"""
