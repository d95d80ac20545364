"""Where frames of a live performance go: one file for each protocol, registered by the scheme of its address."""

from facediff.live.receivers.browser import Browser as Browser
from facediff.live.receivers.json_lines import JsonLines as JsonLines
from facediff.live.receivers.live_link import LiveLink as LiveLink
from facediff.live.receivers.osc import Osc as Osc
from facediff.live.receivers.osc import Vmc as Vmc

__all__ = ["Browser", "JsonLines", "LiveLink", "Osc", "Vmc"]
