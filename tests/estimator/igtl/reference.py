"""Messages of OpenIGTLink read by its specification, with nothing that packs them."""

import socket
import struct

import numpy as np

CRC_POLYNOMIAL = 0x42F0E1EBA9EA3693  # ECMA-182


def crc64(data: bytes) -> int:
    """Checksum of a body, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = ((crc << 1) ^ (CRC_POLYNOMIAL if crc >> 63 else 0)) & 0xFFFFFFFFFFFFFFFF
    return crc


def split(message: bytes) -> tuple[str, str, float, int, bytes]:
    """Type, device, stamp (s), checksum and body of one message."""
    version, kind, name, seconds, fraction, size, crc = struct.unpack(">H12s20sIIQQ", message[:58])
    assert version == 1 and len(message) == 58 + size
    plain = [field.rstrip(b"\0").decode("ascii") for field in (kind, name)]
    return plain[0], plain[1], seconds + fraction / 2**32, crc, message[58:]


def surface(body: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and triangles (m, 3) of a POLYDATA body."""
    points, vertices, v_size, lines, l_size, polygons, size, strips, s_size, attributes = struct.unpack(
        ">10I", body[:40]
    )
    assert (vertices, v_size, lines, l_size, strips, s_size, attributes) == (0,) * 7
    assert len(body) == 40 + 12 * points + size and size == 16 * polygons
    places = np.frombuffer(body, ">f4", 3 * points, 40).reshape(-1, 3)
    cells = np.frombuffer(body, ">u4", 4 * polygons, 40 + 12 * points).reshape(-1, 4)
    assert (cells[:, 0] == 3).all()
    return places.astype(float), cells[:, 1:].astype(int)


def receive(connection: socket.socket) -> bytes:
    """One whole message."""
    data = b""
    size = 58
    while len(data) < size:
        part = connection.recv(size - len(data))
        assert part, "the server closed the connection"
        data += part
        if len(data) == 58:
            size = 58 + struct.unpack(">Q", data[42:50])[0]
    return data
