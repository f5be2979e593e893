"""Bytes to frames and back, without I/O: kernels driven by the layout of a profile.

layout    layout of one profile's messages        tables    the same as arrays, for the kernels
check     CRC and sums
fields    bytes of one message -> one FRAME record
stream    a byte stream -> frames, whatever is between them
candump   candump log text -> CAN messages        can    CAN messages -> frames
decoder   either of them, or a capture -> frames; counts of what is no frame
encode    pulses -> frames or messages (for the simulator and the tests)
datagram  the I50N output datagram, both directions
"""
