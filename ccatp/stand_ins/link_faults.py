"""Edge. The link's part of a fault plan: switches the proxy on and off by the robot's clock, and keeps the record."""

from math import inf

from ccatp.fault_proxy.proxy import Direction, FaultProxy
from ccatp.sim.faults.link_models import LastingLinkFault, LinkFault, Reset
from ccatp.sim.faults.record import Injected


class _Watched:
    """One fault of the plan and what became of it."""

    def __init__(self, fault: LinkFault) -> None:
        self.fault = fault
        self.from_s: float | None = None
        self.until_s: float | None = None
        self.count_before = self.count = 0

    @property
    def injected(self) -> Injected:
        return Injected("link", self.fault.type, self.fault.at_s, self.from_s, self.until_s, self.count, self.count)


class LinkFaults:
    """Faults of the link, ruled by the robot's clock.

    Args:
        plan: the faults.
        proxy: what they are done by.
    """

    def __init__(self, plan: tuple[LinkFault, ...], proxy: FaultProxy) -> None:
        self._proxy = proxy
        self._watched = [_Watched(fault) for fault in plan]
        for fault in plan:
            if fault.after_bytes is not None and _is_armed(fault):
                proxy.reset_after(fault.after_bytes)

    @property
    def injected(self) -> tuple[Injected, ...]:
        """The record of each fault, in the order of the plan."""
        for one in self._watched:
            if one.from_s is not None and one.until_s is None:
                self._count(one)
        return tuple(one.injected for one in self._watched)

    def tick(self, t_s: float) -> list[tuple[str, Injected]]:
        """Begin and end what is due at a robot time; what began (``begins``) and ended (``ended``)."""
        news = []
        for one in self._watched:
            if one.from_s is None and self._is_due(one.fault, t_s):
                one.from_s = t_s
                if not _is_armed(one.fault):
                    one.count_before = self._proxy.counts[one.fault.type]
                    begin(one.fault, self._proxy)
                if not isinstance(one.fault, LastingLinkFault):
                    one.until_s = t_s
                self._count(one)
                news.append(("begins", one.injected))
            elif one.from_s is not None and one.until_s is None and t_s >= one.from_s + _length_s(one.fault):
                self._count(one)
                one.until_s = t_s
                end(one.fault, self._proxy)
                news.append(("ended", one.injected))
        return news

    def _is_due(self, fault: LinkFault, t_s: float) -> bool:
        proxy = self._proxy
        if fault.at_s is not None:
            return t_s >= fault.at_s
        if fault.after_lines is not None:
            return proxy.passed_lines >= fault.after_lines
        return fault.after_bytes is not None and proxy.passed_bytes >= fault.after_bytes

    def _count(self, one: _Watched) -> None:
        one.count = self._proxy.counts[one.fault.type] - one.count_before


def begin(fault: LinkFault, proxy: FaultProxy) -> None:
    """Let the proxy do what a fault says: the method of its type takes the keys that the type has for itself."""
    values = fault.model_dump(exclude=set(LastingLinkFault.model_fields))
    start = getattr(proxy, fault.type)
    if isinstance(fault, LastingLinkFault):
        start(_way(fault), **values)
    else:
        start()


def end(fault: LinkFault, proxy: FaultProxy) -> None:
    """End it."""
    proxy.heal(_way(fault), fault.type)


def _is_armed(fault: LinkFault) -> bool:
    """Whether the proxy itself waits for the moment, to the byte."""
    return isinstance(fault, Reset) and fault.after_bytes is not None


def _way(fault: LinkFault) -> Direction:
    direction = fault.direction if isinstance(fault, LastingLinkFault) else "both"
    return "to_server" if direction == "to_robot" else direction


def _length_s(fault: LinkFault) -> float:
    for_s = fault.for_s if isinstance(fault, LastingLinkFault) else None
    return inf if for_s is None else for_s
