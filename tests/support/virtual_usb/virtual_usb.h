/* A stand-in for libusb-1.0 whose bus holds virtual Kinects, for tests of everything above USB.
 *
 *   kinect.c           one virtual Kinect: its folder, plugging, faults, log
 *   camera_commands.c  what the camera answers to register and parameter commands
 *   motor_commands.c   LED, tilt and accelerometer
 *   iso_stream.c       which packet of which frame crosses the bus in which microframe
 *   libusb_devices.c   libusb API: contexts, enumeration, handles
 *   libusb_descriptors.c  ... device, configuration and string descriptors
 *   libusb_control.c   ... control and bulk transfers
 *   libusb_transfers.c ... isochronous transfers, event loop
 *
 * virtual_bus.py describes the folders that make the bus and drives them from tests.
 */
#ifndef VIRTUAL_USB_H
#define VIRTUAL_USB_H

#include <libusb.h>
#include <limits.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define MAX_KINECTS 8
#define SLOT_NS 125000LL /* a USB 2 microframe; one isochronous packet per endpoint and microframe */
#define REGISTERS 0x400
#define PRODUCT_STRING 1
#define AUDIO_ANSWERS 8

enum model { MODEL_1414, MODEL_1473, MODEL_K4W };
enum function { CAMERA, MOTOR, AUDIO, HUB, FUNCTIONS };
enum stream_id { VIDEO, DEPTH, STREAMS };
enum image_kind { BAYER, BAYER_HIGH, IR, IR_HIGH, DEPTH_11BIT, IMAGE_KINDS };

struct kinect;
struct bus;

struct libusb_context {
    struct bus *bus;
};

struct libusb_device {
    struct kinect *kinect;
    enum function function;
};

struct libusb_device_handle {
    struct libusb_device *device;
    uint64_t plug; /* of the Kinect when opened; another plug means that this handle's device is gone */
};

/* A file of equal frames, mapped into memory and looped. */
struct frame_file {
    const uint8_t *bytes;
    size_t size;
    size_t frames;
};

struct stream {
    bool on;
    enum image_kind kind;
    int64_t on_since_slot;
    int pending;            /* transfers submitted and not yet completed */
    int64_t next_free_slot; /* the slots of pending transfers end here */
};

/* What an audio device sends at one reading. */
struct audio_answer {
    uint8_t bytes[104];
    int length;
};

/* What a test may switch on while the device is in use. */
struct faults {
    bool deny;                /* opening fails with EACCES */
    bool busy;                /* another program has claimed the camera */
    bool mute;                /* the camera never answers control transfers; a reset cures it */
    bool mute_motor;          /* the motor never answers; an audio device keeps its answers for later */
    bool deaf_sensor;         /* commands to the colour sensor's registers fail */
    bool stall;               /* isochronous packets stay empty */
    double lose_percent;      /* of isochronous packets, at random */
    int lose_packet[STREAMS]; /* this packet (-1: none) ... */
    int lose_every[STREAMS];  /* ... of every n-th frame */
};

struct kinect {
    struct bus *bus;
    int index;
    char folder[PATH_MAX];
    struct libusb_device functions[FUNCTIONS];

    bool present;
    uint64_t plug;          /* counts power-ons */
    uint64_t plug_identity; /* of the `present` file, so that a quick replug is noticed */
    uint64_t resets;
    int64_t powered_ns;
    int64_t next_refresh_ns;

    enum model model;
    char serial[64];
    uint32_t first_tick; /* of the 60-MHz clock at power-on */
    struct faults faults;
    libusb_device_handle *camera_claimed_by;

    uint16_t registers[REGISTERS];
    uint16_t cmos[REGISTERS];
    uint8_t reply[0x200];
    int reply_length;
    bool audio_firmware; /* loaded; else the audio device's boot loader answers nothing */
    struct audio_answer audio_answers[AUDIO_ANSWERS];
    int audio_answer_count; /* waiting to be read, oldest first */

    struct frame_file frames[IMAGE_KINDS];
    struct stream streams[STREAMS];
    uint32_t random;
};

struct bus {
    struct bus *next;
    char folder[PATH_MAX];
    int64_t frame_ns;
    struct kinect kinects[MAX_KINECTS];
};

/* kinect.c; everything but the lock itself wants the lock held */
void bus_lock(void);
void bus_unlock(void);
struct bus *bus_of_environment(void);
int64_t now_ns(void);
void sleep_ns(int64_t duration_ns); /* without the lock */
bool kinect_refresh(struct kinect *kinect); /* true while plugged in */
int64_t kinect_slot(const struct kinect *kinect);
void kinect_log(struct kinect *kinect, const char *format, ...) __attribute__((format(printf, 2, 3)));
void kinect_read_line(struct kinect *kinect, const char *name, char *line, size_t size);
void kinect_reset(struct kinect *kinect);
bool handle_alive(libusb_device_handle *handle);

/* camera_commands.c */
void camera_command(struct kinect *kinect, const uint8_t *request, int length);
int camera_reply(struct kinect *kinect, uint8_t *data, int size);

/* motor_commands.c; return the bytes moved or a libusb error, and reading TIMEOUT while there is nothing */
int motor_control(struct kinect *kinect, int type, int request, int value, uint8_t *data, int size);
int audio_write(struct kinect *kinect, const uint8_t *data, int size);
int audio_read(struct kinect *kinect, uint8_t *data, int size);

/* iso_stream.c */
void stream_start(struct kinect *kinect, enum stream_id id, enum image_kind kind);
void stream_stop(struct kinect *kinect, enum stream_id id);
int stream_packet(struct kinect *kinect, enum stream_id id, int64_t slot, uint8_t *packet, int size);
size_t image_bytes(enum image_kind kind);

/* libusb_devices.c */
struct bus *bus_of_context(libusb_context *context);

/* libusb_descriptors.c */
const char *device_string(const struct libusb_device *device, int index);

#endif
