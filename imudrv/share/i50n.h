/*
 * I50N: the output datagram of the IMU50 driver, version 1. One header, C99 or C++, without dependencies.
 *
 *     struct i50n_sample sample;
 *     for (size_t at = 0; at < n; at += I50N_SIZE)
 *         if (i50n_decode(packet + at, n - at, &sample) == I50N_OK)
 *             use(&sample);
 *
 * A packet carries one sample or several back to back. Increments cover `interval_ns`, never an assumed time.
 * Bytes are read one at a time: any byte order of the machine, any alignment of the packet.
 */
#ifndef I50N_H
#define I50N_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define I50N_VERSION 1
#define I50N_SIZE 76 /* bytes a sample */

/* Offset of each number, little-endian. */
#define I50N_AT_VERSION 4      /* u8, after the letters I50N */
#define I50N_AT_SOURCE 5       /* u8 */
#define I50N_AT_FLAGS 6        /* u16 */
#define I50N_AT_COUNTER 8      /* u32 */
#define I50N_AT_INTERVAL_NS 12 /* u32 */
#define I50N_AT_T_NS 16        /* i64 */
#define I50N_AT_DTHETA 24      /* f64[3] */
#define I50N_AT_DV 48          /* f64[3] */
#define I50N_AT_CRC 72         /* u32: CRC-32 (as zlib's) of all bytes before it */

enum i50n_source { I50N_HARDWARE = 0, I50N_REPLAY = 1, I50N_SIMULATOR = 2 };

enum i50n_flag {
    I50N_VALID = 1 << 0,
    I50N_MISSING_BEFORE = 1 << 1,    /* samples are missing before this one */
    I50N_LONG_INTERVAL = 1 << 2,     /* the increments bridge a gap */
    I50N_SATURATED = 1 << 3,
    I50N_FAULT = 1 << 4,             /* a fault bit in the unit's status word */
    I50N_TEMPERATURE_RANGE = 1 << 5, /* outside of the calibrated range */
    I50N_SIZE_EFFECT = 1 << 6,       /* compensated */
    I50N_CLOCK_UNLOCKED = 1 << 7,    /* t_ns is not reliable yet */
    I50N_WARM_UP = 1 << 8,
    I50N_GAP_BY_HOST_TIME = 1 << 9,    /* the gap before this sample is known from host time only */
    I50N_GAP_LENGTH_UNKNOWN = 1 << 10, /* more samples may be missing than the counter shows */
    I50N_CLOCK_STEPPED = 1 << 11       /* the host's clock was set, or the host slept: t_ns may jump, also back */
};

enum i50n_result { I50N_OK = 0, I50N_TOO_SHORT, I50N_BAD_MAGIC, I50N_BAD_VERSION, I50N_BAD_CRC };

struct i50n_sample {
    int64_t t_ns;         /* end of the interval, ns since the UNIX epoch */
    double dtheta_b[3];   /* angle increment, rad, body axes: X right, Y front, Z up */
    double dv_b[3];       /* velocity increment at the origin of b, m/s, body axes */
    uint32_t counter;     /* of the unit, wraps at 2^32 */
    uint32_t interval_ns; /* that the increments cover */
    uint16_t flags;       /* of enum i50n_flag */
    uint8_t source;       /* of enum i50n_source */
};

/* Assumptions of this header; where one is false it does not compile. */
typedef char i50n_a_double_has_8_bytes[sizeof(double) == 8 ? 1 : -1];
typedef char i50n_angles_fit[I50N_AT_DTHETA + 3 * sizeof(double) == I50N_AT_DV ? 1 : -1];
typedef char i50n_velocities_fit[I50N_AT_DV + 3 * sizeof(double) == I50N_AT_CRC ? 1 : -1];
typedef char i50n_the_crc_is_last[I50N_AT_CRC + 4 == I50N_SIZE ? 1 : -1];

static inline uint32_t i50n_u32(const uint8_t *p)
{
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static inline uint64_t i50n_u64(const uint8_t *p)
{
    return (uint64_t)i50n_u32(p) | (uint64_t)i50n_u32(p + 4) << 32;
}

static inline double i50n_f64(const uint8_t *p)
{
    const uint64_t bits = i50n_u64(p);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* CRC-32 as zlib's, four bits at a time. */
static inline uint32_t i50n_crc(const uint8_t *p, size_t n)
{
    static const uint32_t table[16] = {
        0x00000000, 0x1db71064, 0x3b6e20c8, 0x26d930ac, 0x76dc4190, 0x6b6b51f4, 0x4db26158, 0x5005713c,
        0xedb88320, 0xf00f9344, 0xd6d6a3e8, 0xcb61b38c, 0x9b64c2b0, 0x86d3d2d4, 0xa00ae278, 0xbdbdf21c
    };
    uint32_t crc = 0xffffffff;
    size_t k;
    for (k = 0; k < n; k++) {
        crc ^= p[k];
        crc = crc >> 4 ^ table[crc & 15];
        crc = crc >> 4 ^ table[crc & 15];
    }
    return ~crc;
}

/* Read the sample that begins at `bytes`, of which there are `n`; `out` is written on I50N_OK only. */
static inline enum i50n_result i50n_decode(const uint8_t *bytes, size_t n, struct i50n_sample *out)
{
    uint64_t t_ns;
    int axis;
    if (n < I50N_SIZE)
        return I50N_TOO_SHORT;
    if (memcmp(bytes, "I50N", 4) != 0)
        return I50N_BAD_MAGIC;
    if (bytes[I50N_AT_VERSION] != I50N_VERSION)
        return I50N_BAD_VERSION;
    if (i50n_u32(bytes + I50N_AT_CRC) != i50n_crc(bytes, I50N_AT_CRC))
        return I50N_BAD_CRC;
    out->source = bytes[I50N_AT_SOURCE];
    out->flags = (uint16_t)(bytes[I50N_AT_FLAGS] | bytes[I50N_AT_FLAGS + 1] << 8);
    out->counter = i50n_u32(bytes + I50N_AT_COUNTER);
    out->interval_ns = i50n_u32(bytes + I50N_AT_INTERVAL_NS);
    t_ns = i50n_u64(bytes + I50N_AT_T_NS);
    memcpy(&out->t_ns, &t_ns, sizeof t_ns);
    for (axis = 0; axis < 3; axis++) {
        out->dtheta_b[axis] = i50n_f64(bytes + I50N_AT_DTHETA + 8 * axis);
        out->dv_b[axis] = i50n_f64(bytes + I50N_AT_DV + 8 * axis);
    }
    return I50N_OK;
}

#endif
