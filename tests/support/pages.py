"""What stands in the page of a moving picture: the messages that viser plays, with their times."""

import base64
import re

import msgspec
import numpy as np
import zstandard


class Page:
    """The messages of a page; `duration` [s] of playing."""

    def __init__(self, html):
        found = re.search(r'__VISER_EMBED_DATA__="([^"]*)"', html)
        assert found is not None
        raw = zstandard.ZstdDecompressor().decompressobj().decompress(base64.b64decode(found.group(1))[8:])
        start = 8 + int.from_bytes(raw[:8], "little")
        content = msgspec.msgpack.decode(raw[8:start])
        self.duration, self.messages = content["durationSeconds"], content["messages"]
        self._buffers = []
        for length in content["binaryBufferLengths"]:
            start += -start % 8
            self._buffers.append(raw[start : start + length])
            start += length

    def names(self):
        """Nodes that the page shows."""
        return {message["name"] for _, message in self.messages if "props" in message}

    def values(self, name, field):
        """The times at which a property of a node is given, and its values from then on."""
        found = [
            (time, held[field])
            for time, message in self.messages
            if message.get("name") == name and field in (held := message.get("props") or message.get("updates") or {})
        ]
        return np.array([time for time, _ in found]), [self._read(value) for _, value in found]

    def _read(self, value):
        if isinstance(value, dict):
            return np.frombuffer(self._buffers[value["__binary_index"]], value["dtype"])
        return value
