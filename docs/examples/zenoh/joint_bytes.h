/* The bytes of docs/wire.md, in C and C++: the attachment, and a sensor_msgs/msg/JointState. */
#ifndef JOINT_BYTES_H
#define JOINT_BYTES_H
#include <stdint.h>
#include <string.h>

/* Little endian, whatever the machine. */
static void put(uint8_t* out, size_t* at, uint64_t value, int bytes) {
    for (int i = 0; i < bytes; i++) out[(*at)++] = (uint8_t)(value >> (8 * i));
}

/* CDR aligns each value to its own size, counted behind the 4 bytes of encapsulation. */
static void put_aligned(uint8_t* out, size_t* at, uint64_t value, int bytes) {
    while ((*at - 4) % (size_t)bytes) out[(*at)++] = 0;
    put(out, at, value, bytes);
}

/* A string: its length with the zero at its end, then both. */
static void put_text(uint8_t* out, size_t* at, const char* text) {
    size_t length = strlen(text) + 1;
    put_aligned(out, at, length, 4);
    memcpy(out + *at, text, length);
    *at += length;
}

/* Number, time of the sample [ns since 1970], 16, publisher id: 33 bytes. */
static size_t attachment(uint8_t* out, int64_t sequence, int64_t source_ns, const uint8_t* gid) {
    size_t at = 0;
    put(out, &at, (uint64_t)sequence, 8);
    put(out, &at, (uint64_t)source_ns, 8);
    put(out, &at, 16, 1);
    memcpy(out + at, gid, 16);
    return at + 16;
}

/* Three joints; velocity and effort stay empty. At most 256 bytes. */
static size_t joint_state(uint8_t* out, int64_t stamp_ns, const double* position_rad) {
    static const char* const names[] = {"shoulder", "elbow", "wrist"};
    size_t at = 0;
    put(out, &at, 0x0100, 4); /* encapsulation 00 01 00 00: CDR, little endian */
    put_aligned(out, &at, (uint64_t)(stamp_ns / 1000000000), 4);
    put_aligned(out, &at, (uint64_t)(stamp_ns % 1000000000), 4);
    put_text(out, &at, "base_link");
    put_aligned(out, &at, 3, 4);
    for (int i = 0; i < 3; i++) put_text(out, &at, names[i]);
    put_aligned(out, &at, 3, 4);
    for (int i = 0; i < 3; i++) {
        uint64_t bits;
        memcpy(&bits, &position_rad[i], 8);
        put_aligned(out, &at, bits, 8);
    }
    put_aligned(out, &at, 0, 4);
    put_aligned(out, &at, 0, 4);
    return at;
}
#endif
