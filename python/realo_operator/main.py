"""The main of a program that hosts an operator."""

import difflib
import json
import os
import sys
import traceback
from types import SimpleNamespace


def run(operator):
    """Hosts an operator class with the arguments of the command line (`key=value`, as in the graph) until its streams
    end, on dora or, with `REALO_DRIVER=pipe`, for a run in virtual time. Ends the process: 0, or 1 with the error."""
    try:
        stage = operator(configuration(operator, sys.argv[1:]))
        driver = os.environ.get("REALO_DRIVER", "")
        if driver == "pipe":
            from .pipe import serve
        elif driver == "":
            from .realtime import serve
        else:
            raise ValueError(f"REALO_DRIVER: expected `pipe`, or nothing for dora, found `{driver}`")
        serve(stage)
    except Exception as error:  # noqa: BLE001: whatever it is, the run must hear of it
        if not isinstance(error, (ValueError, RuntimeError)):
            traceback.print_exc()
        print(f"realo: {operator.NAME}: {error}", file=sys.stderr, flush=True)
        # dora's threads must not keep a process alive that has failed.
        os._exit(1)
    sys.stdout.flush()
    sys.stderr.flush()


def configuration(operator, args):
    """The defaults of an operator with `key=value` arguments over them; a value is JSON, or of the default's type."""
    values = dict(operator.DEFAULTS)
    seen = set()
    for arg in args:
        key, equals, text = arg.partition("=")
        if not equals:
            raise ValueError(f"argument `{arg}` is not of the form key=value")
        if key in seen:
            raise ValueError(f"argument `{key}` is given twice")
        seen.add(key)
        if key not in values:
            near = difflib.get_close_matches(key, values, 1)
            hint = f" (did you mean `{near[0]}`?)" if near else ""
            raise ValueError(f"unknown argument `{key}`{hint}; it takes: {', '.join(values)}")
        values[key] = _value(key, text, values[key])
    return SimpleNamespace(**values)


def _value(key, text, default):
    if isinstance(default, str):
        return text
    if isinstance(default, list) and not text.lstrip().startswith("["):
        return [_number_or_text(part.strip()) for part in text.split(",") if part.strip()]
    try:
        value = json.loads(text, parse_constant=_refused)
    except ValueError as error:
        raise ValueError(f"argument `{key}`: `{text}` is no value: {error}") from error
    if isinstance(default, bool) != isinstance(value, bool) and default is not None:
        raise ValueError(f"argument `{key}`: expected a value like `{default}`, found `{text}`")
    if isinstance(default, (int, float)) and not isinstance(value, (int, float)):
        raise ValueError(f"argument `{key}`: expected a number, found `{text}`")
    if isinstance(default, int) and not isinstance(value, int):
        raise ValueError(f"argument `{key}`: expected a whole number, found `{text}`")
    return float(value) if isinstance(default, float) else value


def _number_or_text(text):
    try:
        value = json.loads(text, parse_constant=_refused)
    except ValueError:
        return text
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else text


def _refused(constant):
    raise ValueError(f"`{constant}` is no number")
