/* libusb API: control and bulk transfers, which are answered at once unless camera or motor is mute. */
#include "virtual_usb.h"

#include <string.h>

#define GET_DESCRIPTOR 6
#define STRING_DESCRIPTOR 3
#define DEVICE_TO_HOST 0x80
#define POLL_NS 2000000LL /* how soon a mute camera's cure is noticed */

static int string_descriptor(const struct libusb_device *device, int index, uint8_t *data, int size)
{
    static const uint8_t languages[] = {4, STRING_DESCRIPTOR, 0x09, 0x04};
    uint8_t descriptor[2 + 2 * 64] = {0};
    int length = sizeof languages;
    const char *text = index ? device_string(device, index) : NULL;
    if (index && !text)
        return LIBUSB_ERROR_PIPE;
    if (text) {
        length = 2 + 2 * (int)strlen(text);
        descriptor[0] = (uint8_t)length;
        descriptor[1] = STRING_DESCRIPTOR;
        for (int i = 0; text[i]; i++)
            descriptor[2 + 2 * i] = (uint8_t)text[i]; /* UTF-16 */
    } else {
        memcpy(descriptor, languages, sizeof languages);
    }
    int given = length < size ? length : size;
    memcpy(data, descriptor, (size_t)given);
    return given;
}

int libusb_get_string_descriptor_ascii(
    libusb_device_handle *handle, uint8_t index, unsigned char *data, int size)
{
    bus_lock();
    const char *text = device_string(handle->device, index);
    int result = handle_alive(handle) ? (int)(text ? strlen(text) : 0) : LIBUSB_ERROR_NO_DEVICE;
    if (result == 0 || result >= size)
        result = LIBUSB_ERROR_INVALID_PARAM;
    if (result > 0)
        memcpy(data, text, (size_t)result + 1);
    bus_unlock();
    return result;
}

static bool is_mute(const struct libusb_device *device)
{
    const struct faults *faults = &device->kinect->faults;
    return (device->function == CAMERA && faults->mute) || (device->function == MOTOR && faults->mute_motor);
}

/* Wait while the device does not answer: until cured, reset (EIO), unplugged or timed out. */
static int wait_for_answer(libusb_device_handle *handle, unsigned timeout_ms)
{
    struct kinect *kinect = handle->device->kinect;
    int64_t end_ns = now_ns() + (timeout_ms ? timeout_ms * 1000000LL : INT64_MAX / 2);
    bus_lock();
    kinect->next_refresh_ns = 0; /* a fault just made must hold */
    uint64_t resets = kinect->resets;
    int result = 0;
    while (!result && handle_alive(handle) && is_mute(handle->device)) {
        bus_unlock();
        sleep_ns(POLL_NS);
        bus_lock();
        if (kinect->resets != resets)
            result = LIBUSB_ERROR_IO;
        else if (now_ns() > end_ns)
            result = LIBUSB_ERROR_TIMEOUT;
    }
    if (!result && !handle_alive(handle))
        result = LIBUSB_ERROR_NO_DEVICE;
    bus_unlock();
    return result;
}

static int camera_control(struct kinect *kinect, int type, uint8_t *data, int size)
{
    if (type & DEVICE_TO_HOST)
        return camera_reply(kinect, data, size);
    camera_command(kinect, data, size);
    return size;
}

int libusb_control_transfer(
    libusb_device_handle *handle, uint8_t type, uint8_t request, uint16_t value,
    uint16_t index, unsigned char *data, uint16_t size, unsigned timeout_ms)
{
    (void)index;
    struct kinect *kinect = handle->device->kinect;
    int result = LIBUSB_ERROR_PIPE;
    bool for_string = type == DEVICE_TO_HOST && request == GET_DESCRIPTOR && value >> 8 == STRING_DESCRIPTOR;
    if (!for_string)
        result = wait_for_answer(handle, timeout_ms);
    if (result < 0 && result != LIBUSB_ERROR_PIPE)
        return result;
    bus_lock();
    if (!handle_alive(handle))
        result = LIBUSB_ERROR_NO_DEVICE;
    else if (for_string)
        result = string_descriptor(handle->device, value & 0xff, data, size);
    else if (handle->device->function == CAMERA)
        result = camera_control(kinect, type, data, size);
    else if (handle->device->function == MOTOR)
        result = motor_control(kinect, type, request, value, data, size);
    bus_unlock();
    return result;
}

static int bulk_try(libusb_device_handle *handle, unsigned char endpoint, uint8_t *data, int size)
{
    struct kinect *kinect = handle->device->kinect;
    int result = LIBUSB_ERROR_PIPE;
    bus_lock();
    kinect->next_refresh_ns = 0; /* a fault just made must hold */
    if (!handle_alive(handle))
        result = LIBUSB_ERROR_NO_DEVICE;
    else if (handle->device->function == AUDIO)
        result = endpoint & DEVICE_TO_HOST ? audio_read(kinect, data, size)
                                           : audio_write(kinect, data, size);
    bus_unlock();
    return result;
}

int libusb_bulk_transfer(
    libusb_device_handle *handle, unsigned char endpoint, unsigned char *data, int size, int *moved,
    unsigned timeout_ms)
{
    int64_t end_ns = now_ns() + (timeout_ms ? timeout_ms * 1000000LL : INT64_MAX / 2);
    int result = bulk_try(handle, endpoint, data, size);
    while (result == LIBUSB_ERROR_TIMEOUT && now_ns() < end_ns) {
        sleep_ns(POLL_NS);
        result = bulk_try(handle, endpoint, data, size);
    }
    if (moved)
        *moved = result > 0 ? result : 0;
    return result < 0 ? result : 0;
}

int libusb_interrupt_transfer(
    libusb_device_handle *handle, unsigned char endpoint, unsigned char *data, int size, int *moved,
    unsigned timeout_ms)
{
    (void)handle, (void)endpoint, (void)data, (void)size, (void)timeout_ms;
    if (moved)
        *moved = 0;
    return LIBUSB_ERROR_PIPE;
}
