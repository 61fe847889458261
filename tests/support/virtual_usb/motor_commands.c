/* LED, tilt motor and accelerometer: control transfers to the motor device of a 1414, bulk transfers
 * to the audio device of later models.
 */
#include "virtual_usb.h"

#include <stdio.h>
#include <string.h>

#define REQUEST_OUT 0x40
#define REQUEST_IN 0xc0
#define MOTOR_LED 0x06
#define MOTOR_PROBE 0x10
#define MOTOR_TILT 0x31
#define MOTOR_STATE 0x32

#define AUDIO_LED 0x10
#define AUDIO_TILT 0x803b
#define AUDIO_STATE 0x8032
#define AUDIO_REPLY_MAGIC 0x0a6fe000u

#define COUNTS_PER_G 819

struct posture {
    int x, y, z, tilt, status;
};

/* The file `accel`: "x y z tilt status"; a level sensor when there is none. */
static struct posture posture_of(struct kinect *kinect)
{
    struct posture posture = {0, COUNTS_PER_G, 0, 0, 0};
    char line[64];
    kinect_read_line(kinect, "accel", line, sizeof line);
    sscanf(line, "%d %d %d %d %d", &posture.x, &posture.y, &posture.z, &posture.tilt, &posture.status);
    return posture;
}

static void put16_big_endian(uint8_t *bytes, int value)
{
    bytes[0] = (uint8_t)(value >> 8);
    bytes[1] = (uint8_t)value;
}

static int motor_state(struct kinect *kinect, uint8_t *data, int size)
{
    struct posture posture = posture_of(kinect);
    if (size < 10)
        return LIBUSB_ERROR_OVERFLOW;
    memset(data, 0, 10);
    put16_big_endian(data + 2, posture.x);
    put16_big_endian(data + 4, posture.y);
    put16_big_endian(data + 6, posture.z);
    data[8] = (uint8_t)posture.tilt;
    data[9] = (uint8_t)posture.status;
    return 10;
}

int motor_control(struct kinect *kinect, int type, int request, int value, uint8_t *data, int size)
{
    if (type == REQUEST_OUT && request == MOTOR_LED) {
        kinect_log(kinect, "led %d", value);
        return 0;
    }
    if (type == REQUEST_OUT && request == MOTOR_TILT) {
        kinect_log(kinect, "tilt %d", (int16_t)value);
        return 0;
    }
    if (type == REQUEST_IN && request == MOTOR_STATE)
        return motor_state(kinect, data, size);
    if (type == REQUEST_IN && request == MOTOR_PROBE && size >= 1) {
        data[0] = 0x22;
        return 1;
    }
    return LIBUSB_ERROR_PIPE;
}

/* A command: magic, tag, length, command, argument; returns the bytes taken. */
int audio_write(struct kinect *kinect, const uint8_t *data, int size)
{
    uint32_t words[5] = {0};
    memcpy(words, data, (size_t)size < sizeof words ? (size_t)size : sizeof words);
    kinect->audio_tag = words[1];
    kinect->audio_command = words[3];
    if (words[3] == AUDIO_LED)
        kinect_log(kinect, "led %u", words[4]);
    if (words[3] == AUDIO_TILT)
        kinect_log(kinect, "tilt %d", (int32_t)words[4]);
    return size;
}

/* The answer to the last command: its data, if it has any, then an acknowledgement. */
int audio_read(struct kinect *kinect, uint8_t *data, int size)
{
    int32_t state[26] = {0};
    if (kinect->audio_command == AUDIO_STATE && (size_t)size >= sizeof state) {
        struct posture posture = posture_of(kinect);
        const int32_t values[4] = {posture.x, posture.y, posture.z, posture.tilt / 2};
        memcpy(state + 4, values, sizeof values);
        memcpy(data, state, sizeof state);
        kinect->audio_command = 0;
        return sizeof state;
    }
    const uint32_t acknowledgement[3] = {AUDIO_REPLY_MAGIC, kinect->audio_tag, 0};
    if ((size_t)size < sizeof acknowledgement)
        return LIBUSB_ERROR_OVERFLOW;
    memcpy(data, acknowledgement, sizeof acknowledgement);
    return sizeof acknowledgement;
}
