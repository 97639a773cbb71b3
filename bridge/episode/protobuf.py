"""As much of the Protocol Buffers wire format as video messages need, in both directions.

Source: the Protocol Buffers encoding page and ``descriptor.proto``. ``tests/parity`` holds it
against Google's own package where that is installed.
"""

from collections.abc import Iterator, Sequence

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types."""
INT64_TYPE, INT32_TYPE, STRING_TYPE, MESSAGE_TYPE, BYTES_TYPE = 3, 5, 9, 11, 12
"""``FieldDescriptorProto.Type``."""
_FIXED_SIZES = {FIXED64: 8, FIXED32: 4}
_MAX_VARINT_BYTES = 10
_MASK_64 = (1 << 64) - 1


def varint(value: int) -> bytes:
    """Encode an integer; a negative one as its 64-bit two's complement."""
    value &= _MASK_64
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def number_field(number: int, value: int) -> bytes:
    """Encode an integer field; 0 is the default and takes no bytes."""
    return varint(number << 3 | VARINT) + varint(value) if value else b""


def bytes_field(number: int, value: bytes) -> bytes:
    """Encode a bytes, string or message field, empty ones too."""
    return varint(number << 3 | BYTES) + varint(len(value)) + value


def read_varint(data: memoryview, at: int) -> tuple[int, int]:
    """Return an unsigned integer and the place after it.

    Raises:
        ValueError: The bytes end inside the number, or it has more than 64 bits.
    """
    value = 0
    for place in range(_MAX_VARINT_BYTES):
        if at >= len(data):
            message = "the bytes end inside a number"
            raise ValueError(message)
        byte = data[at]
        at += 1
        value |= (byte & 127) << (7 * place)
        if byte < 128:
            return value & _MASK_64, at
    message = "a number of more than 64 bits"
    raise ValueError(message)


def fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of each field: integers as they are, all else as its bytes.

    Raises:
        ValueError: The bytes end inside a field, or hold a wire type that proto3 has not.
    """
    at = 0
    while at < len(data):
        key, at = read_varint(data, at)
        kind = key & 7
        if kind == VARINT:
            value, at = read_varint(data, at)
            yield key >> 3, value
            continue
        if kind == BYTES:
            size, at = read_varint(data, at)
        elif kind in _FIXED_SIZES:
            size = _FIXED_SIZES[kind]
        else:
            message = f"wire type {kind}"
            raise ValueError(message)
        if size > len(data) - at:
            message = f"field {key >> 3} of {size} bytes runs past the end"
            raise ValueError(message)
        yield key >> 3, data[at : at + size]
        at += size


def signed(value: int) -> int:
    """Read the 64-bit two's complement of an ``int32`` or ``int64`` field."""
    return value - (1 << 64) if value >> 63 else value


def file_descriptor(
    *,
    name: str,
    package: str,
    message: str,
    members: Sequence[tuple[str, int, int, str]],
    imports: Sequence[str] = (),
) -> bytes:
    """Describe a file with one message as an entry of a ``FileDescriptorSet``."""
    described = bytes_field(1, message.encode())
    for member, number, kind, type_name in members:
        field = bytes_field(1, member.encode()) + number_field(3, number)
        field += number_field(4, 1) + number_field(5, kind)  # label: optional
        if type_name:
            field += bytes_field(6, type_name.encode())
        described += bytes_field(2, field)
    body = bytes_field(1, name.encode()) + bytes_field(2, package.encode())
    body += b"".join(bytes_field(3, path.encode()) for path in imports)
    body += bytes_field(4, described) + bytes_field(12, b"proto3")
    return bytes_field(1, body)
