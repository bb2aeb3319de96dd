"""Logs as the mcap library writes them."""

from contextlib import contextmanager

from mcap.reader import make_reader
from mcap.writer import Writer

from undulog.capture.log.messages.definitions import schema_text


@contextmanager
def foreign_log(path, type_name="std_msgs/msg/String", definition=None, **options):
    """Write a file; yields the library's writer and the id of the schema."""
    text = schema_text(type_name) if definition is None else definition
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2", library="elsewhere")
        yield writer, writer.register_schema(type_name, "ros2msg", text.encode())
        writer.finish()


def rewrite(source, path, **options):
    """Write the same records as another make does."""
    with source.open("rb") as stream, path.open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, **options)
        writer.start("ros2", "another make")
        schemas, channels = {}, {}
        for kind, channel, attachment in reader.iter_messages():
            if kind.id not in schemas:
                schemas[kind.id] = writer.register_schema(kind.name, kind.encoding, kind.data)
            if channel.id not in channels:
                facts = (channel.message_encoding, schemas[kind.id], channel.metadata)
                channels[channel.id] = writer.register_channel(channel.topic, *facts)
            times = (
                attachment.log_time,
                attachment.data,
                attachment.publish_time,
                attachment.sequence,
            )
            writer.add_message(channels[channel.id], *times)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                0,
                attachment.create_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )
        writer.finish()
