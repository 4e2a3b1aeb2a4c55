/* A PC program for C4G Open over UDP, from docs/wire.md: cc client.c -lm -o client; ./client PORT

   It turns motor 1 by 0.1 revolutions and back, leaves open mode, and ends with the session (504).
   It checks nothing: for a simulated controller only (`hil simulate`). Little-endian computers. */
#include <arpa/inet.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

enum { CYCLES = 1000, LONGEST = 2048 };
struct axis { int32_t mode; float d[8]; };
struct packet { int32_t number; uint8_t status[4], functionality[4]; struct axis axes[20]; };

int main(int argc, char **argv)
{
    int link = socket(AF_INET, SOCK_DGRAM, 0), n = 0, k = 0, ended = 0;
    float start = 0.0f, last = 0.0f;
    union { uint8_t bytes[LONGEST]; struct packet p; } u;
    struct sockaddr_in here = { .sin_family = AF_INET, .sin_port = htons(argc > 1 ? atoi(argv[1]) : 0) };
    if (link < 0 || bind(link, (struct sockaddr *)&here, sizeof here))
        return 1;
    while (!ended) {
        struct sockaddr_in controller;
        socklen_t size = sizeof controller;
        ssize_t length = recvfrom(link, u.bytes, LONGEST, 0, (struct sockaddr *)&controller, &size);
        int number = u.p.number, all_open = 1;
        if (length < 12)
            continue;
        u.p.number = number % 0x7fff + 1; /* sync, init, drive off: otherwise the same bytes */
        if (number == 10 && length == 1200) {
            memcpy(&n, u.bytes + 12, 4);
        } else if (n && length >= 12 + 36 * n) {
            ended = u.p.axes[0].mode == 504;
            for (int i = 0; i < n; i++)
                all_open &= u.p.axes[i].mode == 4;
            if (u.p.status[0] == 5) { /* drive on */
                if (all_open && k == 0)
                    start = u.p.axes[0].d[0];
                k += all_open;
                int at = k < CYCLES ? k : CYCLES;
                float turn = 0.05f * (1.0f - cosf(6.2831853f * at / CYCLES));
                memset(u.p.status, 0, 8);
                u.p.status[0] = all_open && k > CYCLES && (k - CYCLES) % 100 == 1; /* leave open mode */
                for (int i = 0; i < n; i++) {
                    float target = u.p.axes[i].mode == 4 ? u.p.axes[i].d[0] : 0.0f;
                    memset(u.p.axes[i].d, 0, sizeof u.p.axes[i].d);
                    u.p.axes[i].d[0] = all_open && i == 0 ? start + turn : target;
                    u.p.axes[i].d[1] = all_open && i == 0 ? turn - last : 0.0f;
                }
                last = turn;
            }
        }
        sendto(link, u.bytes, length, 0, (struct sockaddr *)&controller, size);
    }
    return 0;
}
