/* Bytes of the unit to velocity and its measurement matrices, in C: what `tools/bench.py vh` measures beside.
 *
 * One unit (profile imu50-rs422, ICD section 2), one rate filter (causal), one sample interval, one pass:
 * frames are found, checked and accounted for, and each good one is compensated and navigated at once.
 * The equations are those of imudrv/imu/compensation.py, size_effect.py and imudrv/nav/mechanisation.py.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { FRAME = 44, WINDOW = 64, TAPS = 3 };
enum { FAULT = 0x83fe, OVERFLOW = 0x400 }; /* bits of the status word */
static const double T = 1e-3;                            /* sample interval, s */

typedef struct { double x, y, z; } vec;
typedef struct { double w, x, y, z; } quat;

/* Calibration; the fields of UNIT in bench_vh.py, in their order. */
struct unit {
    vec gyro_scale, gyro_bias, C_bg[3];
    vec accelerometer_scale, accelerometer_bias, C_ba[3], a_b[3], r_b[3];
    vec gyro_scale_per_k, gyro_bias_per_k, accelerometer_scale_per_k, accelerometer_bias_per_k;
    double reference_degc, low_degc, high_degc;
};

/* Start and result; the fields of RUN in bench_vh.py, in their order. */
struct run {
    quat q_nb;
    vec v_n;
    double latitude, longitude, height;
    double H[3][9], B[3][3], P[3][9], Q[3][9];
    int64_t good, damaged, missing, out_of_order, duplicate, invalid_counter, restarts;
    int64_t valid, in_range, without_arms; /* of the good ones */
};

static vec add(vec a, vec b) { return (vec){a.x + b.x, a.y + b.y, a.z + b.z}; }
static vec sub(vec a, vec b) { return (vec){a.x - b.x, a.y - b.y, a.z - b.z}; }
static vec scale(double s, vec a) { return (vec){s * a.x, s * a.y, s * a.z}; }
static vec times(vec a, vec b) { return (vec){a.x * b.x, a.y * b.y, a.z * b.z}; }
static double dot(vec a, vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static vec rotate(const vec C[3], vec v) { return (vec){dot(C[0], v), dot(C[1], v), dot(C[2], v)}; }

static vec cross(vec a, vec b)
{
    return (vec){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/* ---- frames ---- */

struct frame {
    uint32_t counter;
    int32_t gyro[3], accelerometer[3];
    int16_t temperature[4]; /* 0.01 degC: gyros, accelerometers */
    uint16_t status;
    int64_t skipped; /* bytes before it */
};

static uint16_t crc_table[8][256];

static void make_crc_table(void)
{
    for (int i = 0; i < 256; i++) {
        uint16_t r = (uint16_t)(i << 8);
        for (int bit = 0; bit < 8; bit++) r = (uint16_t)(r << 1 ^ (r & 0x8000 ? 0x1021 : 0));
        crc_table[0][i] = r;
    }
    for (int k = 1; k < 8; k++)
        for (int i = 0; i < 256; i++) {
            uint16_t r = crc_table[k - 1][i];
            crc_table[k][i] = (uint16_t)(r << 8 ^ crc_table[0][r >> 8]);
        }
}

/* CRC-16/CCITT-FALSE of a multiple of eight bytes, eight at a time. */
static uint16_t crc(const uint8_t *b, int n)
{
    uint16_t r = 0xffff;
    for (; n; n -= 8, b += 8)
        r = crc_table[7][b[0] ^ r >> 8] ^ crc_table[6][b[1] ^ (r & 0xff)] ^ crc_table[5][b[2]]
            ^ crc_table[4][b[3]] ^ crc_table[3][b[4]] ^ crc_table[2][b[5]] ^ crc_table[1][b[6]]
            ^ crc_table[0][b[7]];
    return r;
}

/* Read the next good frame from *at on; after a bad one search on at its second byte. Little-endian machines. */
static bool next_frame(const uint8_t *data, size_t size, size_t *at, struct frame *f)
{
    static const uint8_t header[4] = {0xeb, 0x90, 0x50, 0x26};
    f->skipped = 0;
    for (size_t p = *at; p + FRAME <= size; p++, f->skipped++) {
        const uint8_t *b = data + p;
        uint16_t sent;
        memcpy(&sent, b + 42, 2);
        if (memcmp(b, header, 4) || crc(b + 2, 40) != sent) continue;
        memcpy(&f->counter, b + 4, 4);
        memcpy(f->gyro, b + 8, 12);
        memcpy(f->accelerometer, b + 20, 12);
        memcpy(f->temperature, b + 32, 8);
        memcpy(&f->status, b + 40, 2);
        *at = p + FRAME;
        return true;
    }
    return false;
}

/* ---- accounting ---- */

struct sequence {
    bool started;
    int64_t newest, oldest;
    uint64_t received; /* bit k: newest - k has come */
    int64_t damaged;   /* frames' worth of bytes since the newest */
};

static int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

/* Return by how many samples time advances, 0: the frame is late or comes again. */
static int64_t advance(struct sequence *s, const struct frame *f, int32_t ahead, struct run *run)
{
    if (!s->started || ahead <= -WINDOW) {
        run->restarts += s->started;
        *s = (struct sequence){true, f->counter, f->counter, 1, s->damaged};
        return 1;
    }
    if (ahead > 0) {
        s->newest += ahead;
        s->received = ahead < WINDOW ? s->received << ahead | 1 : 1;
        if (ahead > 1) {
            int64_t damaged = least(ahead - 1, (f->skipped + FRAME - 1) / FRAME + s->damaged);
            run->damaged += damaged;
            run->missing += ahead - 1 - damaged;
            s->damaged = 0;
        }
        return ahead;
    }
    uint64_t mark = (uint64_t)1 << -ahead;
    if (s->received & mark) {
        run->duplicate++;
        return 0;
    }
    s->received |= mark;
    run->out_of_order++;
    if (s->newest + ahead < s->oldest) {
        run->missing += s->oldest - s->newest - ahead - 1;
        s->oldest = s->newest + ahead;
    } else if (run->missing > 0) {
        run->missing--;
    } else {
        run->damaged--;
    }
    return 0;
}

/* ---- compensation ---- */

struct compensation {
    int16_t temperature[4]; /* that the next four are of */
    vec gyro_scale, gyro_bias, accelerometer_scale, accelerometer_bias;
    bool in_range;
    vec tangential[3];        /* size effect: r x a, and the form of a . [w x]^2 r */
    double centripetal[3][6]; /* in xx, yy, zz, xy, yz, zx of w */
    vec dtheta[TAPS - 1];     /* latest first */
    int parts;                /* since the last gap */
    vec w0;
};

static void prepare(struct compensation *c, const struct unit *u)
{
    for (int i = 0; i < 3; i++) {
        vec a = u->a_b[i], r = u->r_b[i];
        c->tangential[i] = cross(r, a);
        double q[6] = {-a.y * r.y - a.z * r.z, -a.z * r.z - a.x * r.x, -a.x * r.x - a.y * r.y,
                       a.x * r.y + a.y * r.x,  a.y * r.z + a.z * r.y,  a.z * r.x + a.x * r.z};
        memcpy(c->centripetal[i], q, sizeof q);
    }
}

static void set_temperature(struct compensation *c, const struct unit *u, const int16_t counts[4])
{
    double k[4];
    c->in_range = true;
    for (int i = 0; i < 4; i++) {
        double degc = 0.01 * counts[i];
        k[i] = degc - u->reference_degc;
        c->in_range &= u->low_degc <= degc && degc <= u->high_degc;
    }
    vec one = {1.0, 1.0, 1.0}, accelerometer = {k[1], k[2], k[3]};
    vec K = times(u->accelerometer_scale, add(one, times(u->accelerometer_scale_per_k, accelerometer)));
    memcpy(c->temperature, counts, sizeof c->temperature);
    c->gyro_scale = times(u->gyro_scale, add(one, scale(k[0], u->gyro_scale_per_k)));
    c->gyro_bias = add(u->gyro_bias, scale(k[0], u->gyro_bias_per_k));
    c->accelerometer_scale = (vec){1.0 / K.x, 1.0 / K.y, 1.0 / K.z};
    c->accelerometer_bias = add(u->accelerometer_bias, times(accelerometer, u->accelerometer_bias_per_k));
}

static vec size_effect(const struct compensation *c, vec w0, vec dtheta, vec w1)
{
    vec m = scale(2.0 / T, dtheta), d = sub(w1, w0); /* twice the middle rate: its products count four times */
    double s[6] = {
        w0.x * w0.x + w1.x * w1.x + m.x * m.x, w0.y * w0.y + w1.y * w1.y + m.y * m.y,
        w0.z * w0.z + w1.z * w1.z + m.z * m.z, w0.x * w0.y + w1.x * w1.y + m.x * m.y,
        w0.y * w0.z + w1.y * w1.z + m.y * m.z, w0.z * w0.x + w1.z * w1.x + m.z * m.x,
    };
    double dv[3];
    for (int i = 0; i < 3; i++) {
        double sum = 0.0;
        for (int j = 0; j < 6; j++) sum += c->centripetal[i][j] * s[j];
        dv[i] = dot(c->tangential[i], d) + T / 6.0 * sum;
    }
    return (vec){dv[0], dv[1], dv[2]};
}

static void compensate(struct compensation *c, const struct unit *u, const struct frame *f, bool after_gap,
                       vec *dtheta_b, vec *dv_b, struct run *run)
{
    if (memcmp(c->temperature, f->temperature, sizeof c->temperature)) set_temperature(c, u, f->temperature);
    run->in_range += c->in_range;
    vec gyro = {f->gyro[0], f->gyro[1], f->gyro[2]};
    vec pulses = {f->accelerometer[0], f->accelerometer[1], f->accelerometer[2]};
    vec dtheta = sub(rotate(u->C_bg, times(gyro, c->gyro_scale)), scale(T, c->gyro_bias));
    vec dv = sub(times(pulses, c->accelerometer_scale), scale(T, c->accelerometer_bias));
    if (after_gap) c->parts = 0;
    c->parts++;
    if (c->parts >= TAPS) {
        vec older = add(scale(2.0, c->dtheta[1]), scale(-7.0, c->dtheta[0]));
        vec w1 = scale(1.0 / (6.0 * T), add(older, scale(11.0, dtheta)));
        if (c->parts > TAPS) dv = sub(dv, size_effect(c, c->w0, dtheta, w1));
        c->w0 = w1;
    }
    run->without_arms += c->parts <= TAPS;
    c->dtheta[1] = c->dtheta[0];
    c->dtheta[0] = dtheta;
    *dtheta_b = dtheta;
    *dv_b = rotate(u->C_ba, dv);
}

/* ---- navigation ---- */

static const double EARTH_RATE = 7.292115e-5, AXIS = 6378137.0, FLATTENING = 1.0 / 298.257223563;

struct earth {
    vec omega_ie;
    double gravity, per_north, per_east, secant, tangent;
    double latitude, height; /* that they are of */
};

static struct earth earth_at(double latitude, double height)
{
    double e2 = FLATTENING * (2.0 - FLATTENING), s = sin(latitude), c = cos(latitude), x = 1.0 - e2 * s * s;
    double surface = 9.7803253359 * (1.0 + 0.00193185265241 * s * s) / sqrt(x), h = height / AXIS;
    double m = 0.00344978650684, across = AXIS / sqrt(x), along = across * (1.0 - e2) / x;
    double f = FLATTENING, above = 1.0 - 2.0 * (1.0 + f + m - 2.0 * f * s * s) * h + 3.0 * h * h;
    return (struct earth){
        {0.0, EARTH_RATE * c, EARTH_RATE * s},
        surface * above, 1.0 / (along + height), 1.0 / (across + height), 1.0 / c, s / c, latitude, height,
    };
}

static quat product(quat p, quat q)
{
    return (quat){
        p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z, p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
        p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x, p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
    };
}

static quat of_vector(vec phi)
{
    double x = dot(phi, phi), c, s;
    if (x < 0.01) {
        c = 1.0 + x * (-1.0 / 8 + x * (1.0 / 384 + x * (-1.0 / 46080)));
        s = 0.5 + x * (-1.0 / 48 + x * (1.0 / 3840 + x * (-1.0 / 645120)));
    } else {
        double angle = sqrt(x);
        c = cos(0.5 * angle), s = sin(0.5 * angle) / angle;
    }
    return (quat){c, s * phi.x, s * phi.y, s * phi.z};
}

static vec turn(quat q, vec v)
{
    vec u = {q.x, q.y, q.z}, t = scale(2.0, cross(u, v));
    return add(v, add(scale(q.w, t), cross(u, t)));
}

static void rows_of(quat q, double C[3][3])
{
    double w = q.w, x = q.x, y = q.y, z = q.z, s = 2.0 / (w * w + x * x + y * y + z * z);
    double rows[3][3] = {
        {1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)},
        {s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)},
        {s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)},
    };
    memcpy(C, rows, sizeof rows);
}

struct navigation {
    struct earth earth;
    vec dtheta1, dv1, dtheta2, omega1; /* of the samples before, and the rate at their end */
};

/* Add the integral of C_nb S to H, and of what B, P and Q are. */
static void measure(struct run *r, const struct unit *u, const struct earth *e, quat halfway, vec dtheta, vec w0,
                    vec w1)
{
    double C[3][3], end = T / 6.0, mid = 4.0 / (6.0 * T);
    rows_of(halfway, C);
    vec d = sub(w1, w0);
    double xx = end * (w0.x * w0.x + w1.x * w1.x) + mid * dtheta.x * dtheta.x;
    double yy = end * (w0.y * w0.y + w1.y * w1.y) + mid * dtheta.y * dtheta.y;
    double zz = end * (w0.z * w0.z + w1.z * w1.z) + mid * dtheta.z * dtheta.z;
    double xy = end * (w0.x * w0.y + w1.x * w1.y) + mid * dtheta.x * dtheta.y;
    double yz = end * (w0.y * w0.z + w1.y * w1.z) + mid * dtheta.y * dtheta.z;
    double zx = end * (w0.z * w0.x + w1.z * w1.x) + mid * dtheta.z * dtheta.x;
    vec Omega[3] = {{-yy - zz, xy - d.z, zx + d.y}, {xy + d.z, -zz - xx, yz - d.x}, {zx - d.y, yz + d.x, -xx - yy}};

    double sensed[9], to_n[3][9]; /* a_i^T Omega; column i of C_nb C_ba, three times */
    for (int i = 0; i < 3; i++) {
        vec a = u->a_b[i], s = add(scale(a.x, Omega[0]), add(scale(a.y, Omega[1]), scale(a.z, Omega[2])));
        memcpy(sensed + 3 * i, &s, sizeof s);
    }
    for (int n = 0; n < 3; n++) {
        vec c = {C[n][0], C[n][1], C[n][2]};
        vec to = add(scale(c.x, u->C_ba[0]), add(scale(c.y, u->C_ba[1]), scale(c.z, u->C_ba[2])));
        for (int j = 0; j < 3; j++) to_n[n][j] = to.x, to_n[n][3 + j] = to.y, to_n[n][6 + j] = to.z;
    }
    double north = 2.0 * T * e->omega_ie.y, up = 2.0 * T * e->omega_ie.z;
    for (int j = 0; j < 9; j++) {
        double h0 = r->H[0][j], h1 = r->H[1][j], h2 = r->H[2][j];
        r->H[0][j] = h0 + (up * h1 - north * h2) + to_n[0][j] * sensed[j];
        r->H[1][j] = h1 - up * h0 + to_n[1][j] * sensed[j];
        r->H[2][j] = h2 + north * h0 + to_n[2][j] * sensed[j];
    }
    double half[3] = {0.5 * dtheta.x, 0.5 * dtheta.y, 0.5 * dtheta.z};
    for (int n = 0; n < 3; n++)
        for (int i = 0; i < 3; i++) {
            r->B[n][i] += T * C[n][i];
            for (int j = 0; j < 3; j++) {
                double gain = C[n][i] * half[j], middle = r->P[n][3 * i + j] + gain;
                r->Q[n][3 * i + j] += T * middle;
                r->P[n][3 * i + j] = middle + gain;
            }
        }
}

static void navigate(struct navigation *s, struct run *r, const struct unit *u, vec dtheta, vec dv)
{
    vec phi = add(dtheta, scale(1.0 / 12.0, cross(s->dtheta1, dtheta)));
    vec sculled = add(dv, scale(1.0 / 12.0, add(cross(s->dtheta1, dv), cross(s->dv1, dtheta))));
    double x = dot(dtheta, dtheta), c1, c2;
    if (x < 0.01) {
        c1 = 1.0 / 2 + x * (-1.0 / 24 + x * (1.0 / 720 + x * (-1.0 / 40320)));
        c2 = 1.0 / 6 + x * (-1.0 / 120 + x * (1.0 / 5040 + x * (-1.0 / 362880)));
    } else {
        double angle = sqrt(x);
        c1 = (1.0 - cos(angle)) / x, c2 = (1.0 - sin(angle) / angle) / x;
    }
    vec turned = cross(dtheta, sculled);
    vec gained = add(sculled, add(scale(c1, turned), scale(c2, cross(dtheta, turned))));

    struct earth *e = &s->earth;
    if (fabs(r->latitude - e->latitude) * AXIS > 0.01 || fabs(r->height - e->height) > 0.01)
        *e = earth_at(r->latitude, r->height);
    vec dv_n = turn(r->q_nb, gained), gravity = {0.0, 0.0, -e->gravity * T}, v = r->v_n;
    vec middle = add(v, scale(0.5, add(dv_n, gravity)));
    double east = middle.x * e->per_east;
    vec omega_in = add(e->omega_ie, (vec){-middle.y * e->per_north, east, east * e->tangent});
    vec zeta = scale(T, omega_in);
    vec coriolis = scale(T, cross(add(e->omega_ie, omega_in), middle));
    r->v_n = add(v, sub(add(dv_n, gravity), add(scale(0.5, cross(zeta, dv_n)), coriolis)));

    vec mean = scale(0.5 * T, add(v, r->v_n));
    double to_north = mean.y * e->per_north;
    r->latitude += to_north;
    r->longitude += mean.x * e->per_east * e->secant * (1.0 + 0.5 * e->tangent * to_north);
    r->height += mean.z;

    quat before = r->q_nb, frame = {1.0, -0.5 * zeta.x, -0.5 * zeta.y, -0.5 * zeta.z};
    quat q = product(frame, product(before, of_vector(phi)));
    double n = 1.5 - 0.5 * (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    r->q_nb = (quat){n * q.w, n * q.x, n * q.y, n * q.z};

    quat halfway = {before.w + r->q_nb.w, before.x + r->q_nb.x, before.y + r->q_nb.y, before.z + r->q_nb.z};
    vec older = add(scale(2.0, s->dtheta2), scale(-7.0, s->dtheta1));
    vec omega = scale(1.0 / (6.0 * T), add(older, scale(11.0, dtheta)));
    measure(r, u, e, halfway, dtheta, s->omega1, omega);
    s->dtheta2 = s->dtheta1, s->dtheta1 = dtheta, s->dv1 = dv, s->omega1 = omega;
}

/* The body rests on the Earth before the first sample. */
static struct navigation at_rest(const struct run *r)
{
    struct earth e = earth_at(r->latitude, r->height);
    quat q_bn = {r->q_nb.w, -r->q_nb.x, -r->q_nb.y, -r->q_nb.z};
    vec rate = turn(q_bn, e.omega_ie), dtheta = scale(T, rate);
    return (struct navigation){e, dtheta, turn(q_bn, (vec){0.0, 0.0, e.gravity * T}), dtheta, rate};
}

/* ---- all of it ---- */

static bool is_saturated(const int32_t counts[3])
{
    bool saturated = false;
    for (int i = 0; i < 3; i++) saturated |= counts[i] == INT32_MAX || counts[i] <= -INT32_MAX;
    return saturated;
}

void process(const uint8_t *data, size_t size, const struct unit *unit, struct run *run)
{
    make_crc_table();
    struct sequence sequence = {0};
    struct compensation compensation = {0};
    struct navigation navigation = at_rest(run);
    struct frame f, after;
    prepare(&compensation, unit);
    for (size_t at = 0; next_frame(data, size, &at, &f);) {
        int32_t ahead = (int32_t)(f.counter - (uint32_t)sequence.newest);
        if (sequence.started && (ahead <= -WINDOW || ahead > WINDOW)) { /* only if the next frame agrees */
            size_t ahead_at = at;
            if (!next_frame(data, size, &ahead_at, &after)
                || llabs((int32_t)(after.counter - f.counter)) > WINDOW) {
                run->invalid_counter++;
                sequence.damaged += (f.skipped + FRAME - 1) / FRAME + 1;
                continue;
            }
        }
        bool restarts = !sequence.started || ahead <= -WINDOW;
        int64_t steps = advance(&sequence, &f, ahead, run);
        if (steps == 0) continue;
        run->good++;
        run->valid += !(f.status & (FAULT | OVERFLOW)) && !is_saturated(f.gyro) && !is_saturated(f.accelerometer);
        vec dtheta_b, dv_b;
        compensate(&compensation, unit, &f, steps > 1 || restarts, &dtheta_b, &dv_b, run);
        navigate(&navigation, run, unit, dtheta_b, dv_b);
    }
}
