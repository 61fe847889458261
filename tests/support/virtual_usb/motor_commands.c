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
#define AUDIO_COMMAND_MAGIC 0x06022009u
#define AUDIO_REPLY_MAGIC 0x0a6fe000u
#define STATE_COMMAND_BYTES 16
#define OTHER_COMMAND_BYTES 20
#define STATE_BYTES 104

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

static void answer(struct kinect *kinect, const void *bytes, int length)
{
    if (kinect->audio_answer_count == AUDIO_ANSWERS)
        return;
    struct audio_answer *last = &kinect->audio_answers[kinect->audio_answer_count++];
    memcpy(last->bytes, bytes, (size_t)length);
    last->length = length;
}

static void answer_state(struct kinect *kinect)
{
    int32_t state[STATE_BYTES / 4] = {0};
    struct posture posture = posture_of(kinect);
    const int32_t values[4] = {posture.x, posture.y, posture.z, posture.tilt / 2};
    memcpy(state + 4, values, sizeof values);
    answer(kinect, state, sizeof state);
}

/* The file `audio_fault` says what is wrong with it: magic, tag, status, short. */
static void acknowledge(struct kinect *kinect, uint32_t tag)
{
    char fault[64];
    kinect_read_line(kinect, "audio_fault", fault, sizeof fault);
    const uint32_t words[3] = {
        strcmp(fault, "magic") ? AUDIO_REPLY_MAGIC : AUDIO_COMMAND_MAGIC,
        strcmp(fault, "tag") ? tag : tag + 1,
        strcmp(fault, "status") ? 0 : 5,
    };
    answer(kinect, words, strcmp(fault, "short") ? sizeof words : 4);
}

/* A command: magic, tag, bytes of data wanted, command, argument unless it is for the state. */
int audio_write(struct kinect *kinect, const uint8_t *data, int size)
{
    uint32_t words[5] = {0};
    if (!kinect->audio_firmware)
        return size;
    if (size != STATE_COMMAND_BYTES && size != OTHER_COMMAND_BYTES)
        return LIBUSB_ERROR_PIPE;
    memcpy(words, data, (size_t)size);
    bool for_state = words[3] == AUDIO_STATE;
    bool known = for_state || words[3] == AUDIO_LED || words[3] == AUDIO_TILT;
    if (!known || words[0] != AUDIO_COMMAND_MAGIC || words[2] != (for_state ? STATE_BYTES : 0) ||
        size != (for_state ? STATE_COMMAND_BYTES : OTHER_COMMAND_BYTES))
        return LIBUSB_ERROR_PIPE;
    if (words[3] == AUDIO_LED)
        kinect_log(kinect, "audio led %u", words[4]);
    if (words[3] == AUDIO_TILT)
        kinect_log(kinect, "audio tilt %d", (int32_t)words[4]);
    if (for_state)
        answer_state(kinect);
    acknowledge(kinect, words[1]);
    return size;
}

/* The oldest answer; what does not fit is lost with it, as on a real bus. */
int audio_read(struct kinect *kinect, uint8_t *data, int size)
{
    if (kinect->faults.mute_motor || kinect->audio_answer_count == 0)
        return LIBUSB_ERROR_TIMEOUT;
    struct audio_answer oldest = kinect->audio_answers[0];
    kinect->audio_answer_count--;
    memmove(kinect->audio_answers, kinect->audio_answers + 1,
            (size_t)kinect->audio_answer_count * sizeof oldest);
    if (size < oldest.length)
        return LIBUSB_ERROR_OVERFLOW;
    memcpy(data, oldest.bytes, (size_t)oldest.length);
    return oldest.length;
}
