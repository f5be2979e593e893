"""Bytes to frames and back, without I/O: a layout says how, kernels do it, nothing here waits or prints.

layout    how one profile's messages look        tables    the same as arrays, for the kernels
check     CRC and sums
fields    bytes of one message -> one FRAME record
stream    a byte stream -> frames, whatever is between them
candump   candump log text -> CAN messages        can    CAN messages -> frames
encode    pulses -> frames or messages (the simulator's and the tests' direction)
datagram  the I50N output datagram, both directions
"""
