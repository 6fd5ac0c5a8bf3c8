"""Checksums that no library has."""

from fastcrc import crc16


def lms_crc(data: bytes | bytearray, start: int, end: int) -> int:
    """SICK LMS2xx checksum of `data[start:end]`, from STX to the last byte before the checksum (LMS2XX section 2).

    Not a catalogued CRC-16: the register shifts once a byte, and each byte enters together with the one before it. As
    polynomials over GF(2), b(i) being the i-th byte from the end, x the shift of the register, and P = 18005h:

        checksum = sum b(i) x^i + sum b(i) x^(i - 1) x^8 mod P      (the last byte, b(0), is before no other)
                 = S + x^7 (S + b(0)) mod P,    S = sum b(i) x^i

    Every eighth byte together is one number, so S is eight numbers, shifted. The remainder is a library's: a plain CRC
    of the same polynomial gives M x^16 mod P.
    """
    body = bytes(data[start:end])
    if not body:
        return 0
    sum_ = 0
    for k in range(8):
        sum_ ^= int.from_bytes(body[-1 - k :: -8], "little") << k
    sum_ ^= (sum_ ^ body[-1]) << 7
    high = sum_ >> 16
    return int(crc16.umts(high.to_bytes((high.bit_length() + 7) // 8, "big"))) ^ (sum_ & 0xFFFF)
