"""What to write instead of what a profile cannot say: the nearest thing, by the key and what it was given."""

import re
from typing import Final

_LONGEST: Final = 80
"""Characters of a path or a value that are looked at."""
_NO_TEXT: Final = "only binary messages can be described: set the unit to one, not to text such as NMEA"
_NO_STUFFING: Final = (
    "stuffed bytes (SLIP, COBS, DLE) cannot be described: set the unit to another format, or remove the "
    "stuffing in a program in between and read that by socket://HOST:PORT"
)
_FIXED_LENGTH: Final = (
    "a message has a fixed length: describe each length as a message of its own, with its length byte in "
    "'constants'"
)
_NOT_USED: Final = "it is not used: leave it out; bytes without a field are skipped"
_CALIBRATION: Final = "it belongs into the calibration file"
_LISTENS: Final = "the driver only listens: set the unit to send by itself"
_PER_COUNT: Final = "write the value of one count in per_count, as in 1.52587890625e-05 for 1/65536"
_CRC: Final = "write kind: crc, with width, polynomial, init, reflected and xor_out"
_NO_CHECK: Final = (
    "such a check cannot be described: leave it out, and messages are recognised by sync and constants alone"
)
_LINE: Final = "write {baudrate: 115200, parity: none, stopbits: 1}"

_KEYS: Final = (
    (r"ascii|delimiter|encoding|end|format|line_ending|separator|terminator|text", _NO_TEXT),
    (r"escape\w*|framing|slip|cobs|dle|\w*stuffing", _NO_STUFFING),
    (r"length_\w+|\w+_length|variable\w*", _FIXED_LENGTH),
    (r"scale\w*|factor|resolution|lsb|sensitivity", _PER_COUNT),
    (r"bias\w*|C_b[ag]|misalignment|calibration", _CALIBRATION),
    (r"range|full_scale|limits?", "saturation is known from whole numbers, and from status bits"),
    (r"magnetometer|quaternion|attitude|pressure|euler|gps", _NOT_USED),
    (r"poll|\w*command|init_\w+|start\w*", _LISTENS),
    (r"poly|crc_poly", "did you mean polynomial?"),
    (r"refin|refout|reflect\w*", "did you mean reflected? It is for input and output together"),
    (r"checks\.(first|last|start|stop)", "write covers: [[first, last]], ranges of bytes"),
    (r"word_order", "byte_order applies to the whole number; swapped words cannot be described"),
    (r"counts", "write what it says in 'values' of gyro and accelerometer"),
    (r"active_low|invert\w*|level|value", "write when: clear for a bit that means this while it is 0"),
    (r"baud", "did you mean baudrate?"),
)
"""Advice by an unknown key."""

_VALUES: Final = (
    (r"transport", r"ascii|nmea|text", _NO_TEXT),
    (r"transport", r"can.?fd", "write can, and data_bitrate in 'line'"),
    (r"transport", r"rs.?(232|422|485)|uart|usb|tty|pty|vcp", "write serial"),
    (r"transport", r"tcp|ethernet|socket", "write serial, and read the port socket://HOST:PORT"),
    (r"transport", r"udp|spi|i2c", "it is not supported: connect the unit by a serial line, TCP or CAN"),
    (r"sync", r".*", "give the bytes in hexadecimal, as in EB 90"),
    (r"messages\.length", r"\D.*", _FIXED_LENGTH),
    (r"fields\.name", r"time.*|clock|t|tow", "did you mean time?"),
    (r"fields\.name", r"packet.*|seq.*|frame.*|index|count|msg.*|cnt", "did you mean counter?"),
    (r"fields\.name", r"acc|accel|acceleration|specific.?force", "did you mean accelerometer?"),
    (
        r"fields\.name",
        r"(gyro|acc\w*).?[xyzXYZ]",
        "write {name: gyro, axis: x} or {name: accelerometer, axis: x}",
    ),
    (r"fields\.name", r"length|len|size", _FIXED_LENGTH),
    (r"fields\.name", r"crc.*|check.*|sum", "write it in 'checks'"),
    (r"fields\.name", r"temp|t_?imu", "did you mean temperature?"),
    (r"fields\.name", r"flags?|error.*|bit|health|valid.*", "did you mean status?"),
    (r"fields\.name", r"gyr\w*|rate|rotation|omega", "did you mean gyro?"),
    (r"fields\.name", r".*", _NOT_USED),
    (r"axis", r"[XYZ]", "in lower case"),
    (r"axis", r".*", "only the three axes x, y, z are used; leave other numbers out"),
    (
        r"type",
        r"[ui](9|1\d|2\d|3\d|4\d|5\d|6[0-3]|[1-7])",
        "take bits of a larger one, as in type: u16, bits: [0, 11]",
    ),
    (r"type", r"[ui]\d+", "take the 64 bits that matter, as in type: u64"),
    (r"type", r"(float|real|single)(_?32)?(_t)?", "write f32"),
    (r"type", r"(double|float_?64|real64)(_t)?", "write f64"),
    (r"type", r"(s|int|sint)_?\d+(_t)?|short|long|int", "write i16 for a signed number of 16 bits"),
    (r"type", r"(uint|unsigned)_?\d*(_t)?|byte|word|dword", "write u16 for an unsigned number of 16 bits"),
    (r"type", r"\w+(le|be)", "give byte_order: little or big beside the type"),
    (
        r"type",
        r"f16|half|bf16|fixed.*|q\d.*",
        "it cannot be described; a fixed-point number is an i16 or i32 with per_count",
    ),
    (r"type", r"ascii|str.*|text|bcd|hex", _NO_TEXT),
    (r"byte_order", r"be|msb.*|motorola|network", "write big"),
    (r"byte_order", r"le|lsb.*|intel", "write little"),
    (r"byte_order", r".*", "give byte_order in each field that differs; swapped words cannot be described"),
    (r"values", r"delta.*|inc.*|d(theta|v)", "write increment"),
    (r"values", r"rates?|angular.*|acc.*", "write rate"),
    (r"values", r"angle.*|abs.*|sum|integral|cumul.*|counts?", "write total if they are running totals"),
    (r"unit", r"m(illi)?.?g(ee)?", "write g, and per_count in g: 0.001 for 1 mg"),
    (r"unit", r"[uµ]g", "write g, and per_count in g: 1.0e-6 for 1 ug"),
    (r"unit", r"mrad.*", "write rad or rad/s, and per_count in it: 0.001 for 1 mrad"),
    (r"unit", r"mdeg.*|mdps", "write deg or deg/s, and per_count in it: 0.001 for 1 mdeg"),
    (r"unit", r"[uµ]rad.*", "write rad or rad/s, and per_count in it: 1.0e-6 for 1 urad"),
    (r"unit", r"dps|°/s|deg/sec|degree.*", "write deg/s"),
    (r"unit", r"rpm", "write deg/s, and per_count in it: 6 for 1 rpm"),
    (r"unit", r"m/s/s|m/s2|m/s²|mps2|m s-2", "write m/s^2"),
    (r"unit", r"[mc]m/s.*|ft/s.*", "write m/s or m/s^2, and per_count in it: 0.3048 for 1 ft/s"),
    (
        r"unit",
        r"counts?|lsb|raw|digits?",
        "write the unit of the vendor's table, and per_count; pulse if the calibration has the scale",
    ),
    (
        r"unit",
        r"°?(deg)?[fF]|K|kelvin|°?(deg)?[cC]",
        "a temperature has no unit: for degF write degc_per_count: 0.55556, degc_at_zero: -17.778",
    ),
    (r"unit", r"min.*|h.*|day.*|week.*", "the time must be finer than a sample; leave this field out"),
    (r"per_count", r"-.*", "for an axis that is counted the other way write sign: -1 in its field"),
    (r"per_count", r".*[/^*].*|\[.*", "write the number: 1.52587890625e-05 for 1/65536"),
    (r"sensor", r".*", "write electronics for any other"),
    (r"bits", r"\d+", "write the first and the last bit, as in [7, 7]"),
    (
        r"bits",
        r".*",
        "write the first and the last bit of one run, as in [0, 6]; a number in pieces cannot be described, "
        "but of a counter the lowest piece is enough",
    ),
    (r"offset", r"\d+\.\d+", "bits inside a byte are chosen by bits: [first, last]"),
    (r"kind", r"crc.?64.*|md5|sha.*|adler.*|hmac", _NO_CHECK),
    (r"kind", r"crc.*", _CRC),
    (r"kind", r"check.?sum|add.*|mod.*", "write sum, with 'complement' if it is negated"),
    (r"kind", r"lrc|bcc|nmea", "write xor, or sum with complement: two"),
    (r"checks\.width", r".*", _NO_CHECK),
    (r"constants", r"\{.*", "write [{offset: 2, value: 0x50}]"),
    (r"covers", r"\d+", "write ranges of bytes, as in [[2, 41]]"),
    (r"checks", r"None", "write [], or leave the key out"),
    (r"sample_rate_hz", r"\d+/\d+", "write numerator and denominator, as in [4096, 5]"),
    (r"sample_rate_hz", r"[1-9]\d*\.\d+", "write a ratio of whole numbers, as in [4096, 5] for 819.2"),
    (
        r"sample_rate_hz",
        r".*[^\d.].*",
        "write the number of samples per second, as in 1000, or a ratio, as in [4096, 5]",
    ),
    (r"line|baudrate", r"\d+.*[ ,/].*", _LINE),
    (r"bitrate|data_bitrate", r"\d+ ?[kM].*", "write the number of bit/s, as in 500000"),
    (r"parity", r"[nN]o?", "write none"),
    (r"parity", r"[eEoOmMsS]", "write even, odd, mark or space"),
    (r"stopbits", r"1\.5", "write 2: a receiver takes both"),
    (
        r"bytesize",
        r"9",
        "nine bits cannot be received; if the ninth is the parity, write parity: even or odd",
    ),
    (r"step", r"-.*", "a counter that goes down cannot be described: leave it out"),
    (r"step", r"\d.*[a-z]", "write the number of ticks of the time in a sample, as in 5000"),
    (r"means", r"err.*|fail.*|alarm|invalid", "write fault"),
    (r"means", r"ok|good|valid|ready", "write fault with when: clear"),
    (r"means", r"warn.*|info.*|mode|reserved", "write nothing: it then has no effect on samples"),
    (r"means", r"over.*|clip.*|sat.*", "write saturated"),
    (r"when", r"0|False|low|off", "write clear"),
    (r"when", r"1|True|high|on", "write set"),
)
"""Advice by a key and the value that it cannot have."""


def for_key(path: str) -> str:
    """Return what to write in place of an unknown key; empty if nothing is known.

    Parameters
    ----------
    path : str
        Keys that lead to it, joined by dots: ``messages.fields.scale``.

    Returns
    -------
    str
    """
    return next((advice for keys, advice in _KEYS if _ends_with(path, keys)), "")


def for_value(path: str, value: object) -> str:
    """Return what to write in place of a value that a key cannot have; empty if nothing is known.

    Parameters
    ----------
    path : str
        Keys that lead to it, joined by dots.
    value : object
        What was found there.

    Returns
    -------
    str
    """
    text = str(value)[:_LONGEST]
    return next(
        (
            advice
            for keys, values, advice in _VALUES
            if _ends_with(path, keys) and re.fullmatch(values, text, re.IGNORECASE | re.DOTALL)
        ),
        "",
    )


def _ends_with(path: str, keys: str) -> bool:
    return re.fullmatch(rf"(.*\.)?({keys})", path[-_LONGEST:], re.DOTALL) is not None
