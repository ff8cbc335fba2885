"""How much memory a call takes at its peak, counted and not timed."""

from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity

CPU = ProfilerActivity.CPU


def peak_bytes(call: Callable[[], Any]) -> int:
    """The most bytes that torch held at once beyond those before the call, temporaries inside its operations included.

    Every allocation on the CPU is an event of the profiler; what numpy or Python allocate is not.
    """
    with torch.profiler.profile(activities=[CPU], profile_memory=True, acc_events=True) as profile:
        kept = call()
    held = peak = 0
    events = (event for event in profile.profiler.kineto_results.events() if event.name() == "[memory]")
    for event in sorted(events, key=lambda event: event.start_ns()):
        held += event.nbytes()
        peak = max(peak, held)
    del kept
    return peak
