/*
 * Receives I50N datagrams over UDP on the loopback and prints them: an example, and a test of the connection.
 *
 *     cc -O2 -std=c99 -o i50n_receiver i50n_receiver.c
 *     imudrv run ... --out udp://127.0.0.1:5005 &
 *     ./i50n_receiver [-q] PORT [COUNT]
 *
 * One line per sample: counter, interval_ns, t_ns, flags, dtheta X Y Z, dv X Y Z. With -q only the summary.
 * Ends after COUNT samples, or on Ctrl-C.
 */
#define _POSIX_C_SOURCE 200809L

#include <arpa/inet.h>
#include <errno.h>
#include <inttypes.h>
#include <netinet/in.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include "i50n.h"

static volatile sig_atomic_t stopped;

struct counts {
    unsigned long long received, lost, bad;
    uint32_t next;
};

static void stop(int number)
{
    (void)number;
    stopped = 1;
}

/* A number from `low` to `high`, or -1. */
static long long number(const char *text, long long low, long long high)
{
    char *end;
    long long value;
    errno = 0;
    value = strtoll(text, &end, 10);
    return errno == 0 && end != text && *end == '\0' && value >= low && value <= high ? value : -1;
}

static int listen_on(uint16_t port)
{
    const int queue = 1 << 22; /* the usual default holds a quarter of a second of single samples */
    const struct timeval timeout = {0, 200000}; /* then check whether to stop */
    struct sockaddr_in address;
    const int fd = socket(AF_INET, SOCK_DGRAM, 0);
    if (fd < 0)
        return -1;
    memset(&address, 0, sizeof address);
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    (void)setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &queue, sizeof queue);
    (void)setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &timeout, sizeof timeout);
    if (bind(fd, (const struct sockaddr *)&address, sizeof address) != 0) {
        (void)close(fd);
        return -1;
    }
    return fd;
}

static void print(const struct i50n_sample *s)
{
    printf("%" PRIu32 " %" PRIu32 " %" PRId64 " %04x %.17g %.17g %.17g %.17g %.17g %.17g\n", s->counter,
           s->interval_ns, s->t_ns, (unsigned)s->flags, s->dtheta_b[0], s->dtheta_b[1], s->dtheta_b[2],
           s->dv_b[0], s->dv_b[1], s->dv_b[2]);
}

/* Count a sample and those lost before it. Up to 64 back it is late or repeated; farther, the unit has restarted. */
static void count_sample(struct counts *counts, uint32_t counter)
{
    const uint32_t gap = counter - counts->next;
    const int started = counts->received > 0;
    counts->received++;
    if (started && gap >= UINT32_MAX - 63)
        return;
    if (started && gap <= INT32_MAX)
        counts->lost += gap;
    counts->next = counter + 1;
}

int main(int argc, char **argv)
{
    static uint8_t packet[65536];
    const int quiet = argc > 1 && strcmp(argv[1], "-q") == 0;
    char **argument = argv + 1 + quiet;
    const int arguments = argc - 1 - quiet;
    struct counts counts = {0, 0, 0, 0};
    struct sigaction action;
    long long port = -1, count = INT64_MAX;
    int fd;

    if (arguments == 1 || arguments == 2)
        port = number(argument[0], 1, 65535);
    if (arguments == 2)
        count = number(argument[1], 1, INT64_MAX);
    if (port < 0 || count < 0) {
        fprintf(stderr, "usage: i50n_receiver [-q] PORT [COUNT]\n");
        return 2;
    }
    memset(&action, 0, sizeof action);
    action.sa_handler = stop;
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    fd = listen_on((uint16_t)port);
    if (fd < 0) {
        perror("i50n_receiver: cannot listen");
        return 1;
    }
    fprintf(stderr, "listening on 127.0.0.1:%lld\n", port);

    while (!stopped && counts.received < (unsigned long long)count) {
        struct i50n_sample sample;
        size_t at, n;
        const ssize_t got = recv(fd, packet, sizeof packet, 0);
        if (got < 0) {
            if (errno == EINTR || errno == EAGAIN || errno == EWOULDBLOCK)
                continue;
            perror("i50n_receiver: recv");
            break;
        }
        n = (size_t)got;
        for (at = 0; at < n && counts.received < (unsigned long long)count; at += I50N_SIZE) {
            if (i50n_decode(packet + at, n - at, &sample) != I50N_OK) {
                counts.bad++;
                continue;
            }
            count_sample(&counts, sample.counter);
            if (!quiet)
                print(&sample);
        }
        fflush(stdout);
    }
    (void)close(fd);
    printf("received %llu, lost %llu, bad %llu\n", counts.received, counts.lost, counts.bad);
    return 0;
}
