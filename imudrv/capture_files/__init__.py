"""Forms in which captures are stored, each read as one of two: wire bytes, or the text of a candump log.

recognise    what a file is, by its name and its content
source       an open file: unpacked, read in bounded pieces and lines
can_logs     logs of other programs (ASC, BLF, TRC, CSV, SQLite, MDF) by python-can
screen       what candump prints on a screen
hex_dump     what terminal programs and xxd print
damage       signs of a wrongly set line or recorder in wire bytes
reader       `CaptureFile`: all of this by the kind of the file
"""

from imudrv.capture_files.damage import DamageSigns
from imudrv.capture_files.reader import CaptureFile, Piece

__all__ = ["CaptureFile", "DamageSigns", "Piece"]
