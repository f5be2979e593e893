"""The status of a running service: what it says, and the socket that says it.

A client connects to the unix socket, gets one line of JSON, and the service hangs up.
"""

from typing import Any, Final, TypeAlias

Status: TypeAlias = dict[str, Any]
"""As of `imudrv.service.loop.Service.status`: text, numbers, lists and mappings."""


_OK, _WARN, _FAIL = "ok", "warn", "fail"


EXIT_CODES: Final = {_OK: 0, _WARN: 3, _FAIL: 4}
"""Exit code of `imudrv status` by health."""


def health(status: Status) -> tuple[str, list[str]]:
    """Judge a status.

    Parameters
    ----------
    status : dict
        Without its `health`.

    Returns
    -------
    str
        ``ok``; ``warn``: samples flow, a person should look; ``fail``: they do not.
    list of str
        Why, in plain words.
    """
    failures, warnings = [], []
    port = status["port"]
    if port["state"] not in ("streaming", "ended"):
        failures.append(f"port {port['state']}: {port['trouble'] or port['url']}")
    elif port["trouble"]:
        warnings.append(port["trouble"])
    if not status["samples"]["closes"]:
        failures.append("the sample counts do not add up: a defect of this product, please report it")
    warnings += [f"unit: {name}" for name in status["unit_status"]["faults"]]
    warnings += [f"{s['url']}: {s['state']}" for s in status["sinks"] if not s["healthy"]]
    recording = status["recording"]
    if recording and not recording["healthy"]:
        failures.append(f"recording {recording['url']}: {recording['state']}")
    if status["samples"]["lost_last_s"]:
        warnings.append(f"{status['samples']['lost_last_s']} samples lost in the last second")
    if port["state"] == "streaming" and not status["clock"]["locked"]:
        warnings.append("clock not locked yet")
    warnings += status["notices"]
    if failures:
        return _FAIL, failures + warnings
    return (_WARN, warnings) if warnings else (_OK, [])
