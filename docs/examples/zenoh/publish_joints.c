/* Publish joints so that robot-gst records them; docs/wire.md explains every step.
 *
 *     cc publish_joints.c -o publish_joints -lzenohc -lm      (zenoh-c 1.x)
 *     ./publish_joints tcp/127.0.0.1:7447 demo 500 100 [NUMBERS TO LEAVE OUT] */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <zenoh.h>

#include "joint_bytes.h"

static int64_t now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static int open_session(z_owned_session_t* session, const char* endpoint) {
    char endpoints[256];
    z_owned_config_t config;
    z_config_default(&config);
    snprintf(endpoints, sizeof endpoints, "[\"%s\"]", endpoint);
    zc_config_insert_json5(z_loan_mut(config), "mode", "\"client\"");
    zc_config_insert_json5(z_loan_mut(config), "connect/endpoints", endpoints);
    zc_config_insert_json5(z_loan_mut(config), "scouting/multicast/enabled", "false");
    return z_open(session, z_move(config), NULL);
}

static int declare(const z_loaned_session_t* session, const char* cell,
                   z_owned_liveliness_token_t* token, z_owned_publisher_t* publisher) {
    char name[256];
    z_view_keyexpr_t key;
    snprintf(name, sizeof name, "%s/alive", cell);
    z_view_keyexpr_from_str(&key, name);
    if (z_liveliness_declare_token(session, token, z_loan(key), NULL) < 0) return -1;

    z_owned_encoding_t encoding;
    z_encoding_from_str(&encoding, "application/cdr;sensor_msgs/msg/JointState");
    z_publisher_options_t options;
    z_publisher_options_default(&options);
    options.encoding = z_move(encoding);
    options.congestion_control = Z_CONGESTION_CONTROL_DROP; /* a control loop never waits */
    options.priority = Z_PRIORITY_REAL_TIME;
    snprintf(name, sizeof name, "%s/joint_states", cell);
    z_view_keyexpr_from_str(&key, name);
    return z_declare_publisher(session, publisher, z_loan(key), &options);
}

static void publish(const z_loaned_publisher_t* publisher, long number, const uint8_t* gid) {
    uint8_t note[33], data[256];
    int64_t stamp_ns = now_ns();
    double angle_rad = sin((double)number / 50);
    double position_rad[3] = {angle_rad, -angle_rad, 0};
    z_owned_bytes_t payload, attached;
    z_bytes_copy_from_buf(&attached, note, attachment(note, number, stamp_ns, gid));
    z_bytes_copy_from_buf(&payload, data, joint_state(data, stamp_ns, position_rad));
    z_publisher_put_options_t options;
    z_publisher_put_options_default(&options);
    options.attachment = z_move(attached);
    z_publisher_put(publisher, z_move(payload), &options);
}

int main(int argc, char** argv) {
    if (argc < 5) return 2;
    uint8_t gid[16];
    FILE* random = fopen("/dev/urandom", "rb");
    if (random == NULL || fread(gid, 1, 16, random) != 16) return 1;
    fclose(random);
    z_owned_session_t session;
    z_owned_liveliness_token_t token;
    z_owned_publisher_t publisher;
    if (open_session(&session, argv[1]) < 0) return 1;
    if (declare(z_loan(session), argv[2], &token, &publisher) < 0) return 1;

    double period_s = 1 / atof(argv[4]);
    struct timespec period = {(time_t)period_s, (long)((period_s - (time_t)period_s) * 1e9)};
    for (long number = 0; number < atol(argv[3]); number++) {
        int is_left_out = 0;
        for (int i = 5; i < argc; i++) is_left_out |= atol(argv[i]) == number;
        nanosleep(&period, NULL);
        if (!is_left_out) publish(z_loan(publisher), number, gid);
    }
    z_drop(z_move(publisher));
    z_drop(z_move(token));
    z_drop(z_move(session));
    return 0;
}
