"""The schemas and channels of an archive: what its messages are, said ahead of them."""

from __future__ import annotations

from hil.archive import container
from hil.archive.container import ChannelRecord, Damage, SchemaRecord


class KnownChannels:
    """Schemas and channels by their numbers; what is announced once stays what it is.

    Were a number or a topic to change its meaning in mid-file, samples of one channel would be
    taken for those of another.
    """

    def __init__(self, known: KnownChannels | None = None) -> None:
        self.schemas: dict[int, SchemaRecord] = dict(known.schemas) if known else {}
        self.channels: dict[int, ChannelRecord] = dict(known.channels) if known else {}

    @property
    def topics(self) -> set[str]:
        """The topics of all channels."""
        return {channel.topic for channel in self.channels.values()}

    def topic(self, channel: int) -> str:
        """The topic of a channel."""
        return self.channels[channel].topic

    def schema(self, topic: str) -> SchemaRecord | None:
        """The schema of a topic's messages, if it was announced."""
        identity = next(one.schema_id for one in self.channels.values() if one.topic == topic)
        return self.schemas.get(identity)

    def take(self, opcode: int, body: bytes, offset: int) -> None:
        """Take a schema or channel record that begins at `offset`; others are passed over.

        Raises:
            Damage: the record is torn, or announces anew as something else what is known.
        """
        if opcode == container.SCHEMA:
            schema = container.schema(body, offset)
            if self.schemas.setdefault(schema.id, schema) != schema:
                raise Damage(offset, f"announces schema {schema.id} a second time, as another")
        elif opcode == container.CHANNEL:
            channel = container.channel(body, offset)
            known = self.channels.values()
            same = [one for one in known if one.id == channel.id or one.topic == channel.topic]
            if same not in ([], [channel]):
                raise Damage(offset, f"announces channel {channel.id} a second time, as another")
            self.channels[channel.id] = channel
