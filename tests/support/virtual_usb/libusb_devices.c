/* libusb API: contexts, enumeration, handles.
 *
 * Kinect n sits at port n+1 of bus 1: a hub with the camera, the motor and the audio device on its
 * ports 1, 2 and 3. The hub itself is not listed.
 */
#include "virtual_usb.h"

#include <stdlib.h>

#define UNUSED __attribute__((unused))
#define BUS_NUMBER 1

static struct libusb_context default_context;

struct bus *bus_of_context(libusb_context *context)
{
    struct libusb_context *used = context ? context : &default_context;
    if (!used->bus)
        used->bus = bus_of_environment();
    return used->bus;
}

int libusb_init(libusb_context **context)
{
    bus_lock();
    libusb_context *created = context ? calloc(1, sizeof *created) : &default_context;
    created->bus = bus_of_environment();
    bus_unlock();
    if (context)
        *context = created;
    return 0;
}

void libusb_exit(libusb_context *context) { free(context); }
void libusb_set_debug(libusb_context *context UNUSED, int level UNUSED) {}
int libusb_set_option(libusb_context *context UNUSED, enum libusb_option option UNUSED, ...) { return 0; }
int libusb_has_capability(uint32_t capability) { return capability == LIBUSB_CAP_HAS_CAPABILITY; }

const struct libusb_version *libusb_get_version(void)
{
    static const struct libusb_version version = {1, 0, 26, 0, "-virtual", "virtual Kinects"};
    return &version;
}

ssize_t libusb_get_device_list(libusb_context *context, libusb_device ***list)
{
    libusb_device **devices = calloc(MAX_KINECTS * HUB + 1, sizeof *devices);
    ssize_t count = 0;
    bus_lock();
    struct bus *bus = bus_of_context(context);
    for (int i = 0; i < MAX_KINECTS; i++) {
        bus->kinects[i].next_refresh_ns = 0; /* a plug just made must be seen */
        if (!kinect_refresh(&bus->kinects[i]))
            continue;
        for (int function = CAMERA; function < HUB; function++)
            devices[count++] = &bus->kinects[i].functions[function];
    }
    bus_unlock();
    *list = devices;
    return count;
}

void libusb_free_device_list(libusb_device **list, int unref UNUSED) { free(list); }
libusb_device *libusb_ref_device(libusb_device *device) { return device; }
void libusb_unref_device(libusb_device *device UNUSED) {}
int libusb_get_device_speed(libusb_device *device UNUSED) { return LIBUSB_SPEED_HIGH; }
uint8_t libusb_get_bus_number(libusb_device *device UNUSED) { return BUS_NUMBER; }

/* Like the kernel, give a new address at every plug. */
uint8_t libusb_get_device_address(libusb_device *device)
{
    uint64_t plugs_before = device->kinect->plug * MAX_KINECTS + (uint64_t)device->kinect->index;
    return (uint8_t)(2 + (plugs_before * FUNCTIONS + device->function) % 120);
}

uint8_t libusb_get_port_number(libusb_device *device)
{
    return (uint8_t)(device->function == HUB ? device->kinect->index + 1 : (int)device->function + 1);
}

int libusb_get_port_numbers(libusb_device *device, uint8_t *ports, int size)
{
    int depth = device->function == HUB ? 1 : 2;
    if (size < depth)
        return LIBUSB_ERROR_OVERFLOW;
    ports[0] = (uint8_t)(device->kinect->index + 1);
    if (depth == 2)
        ports[1] = libusb_get_port_number(device);
    return depth;
}

libusb_device *libusb_get_parent(libusb_device *device)
{
    return device->function == HUB ? NULL : &device->kinect->functions[HUB];
}

int libusb_open(libusb_device *device, libusb_device_handle **handle)
{
    struct kinect *kinect = device->kinect;
    int result = 0;
    bus_lock();
    kinect->next_refresh_ns = 0;
    if (!kinect_refresh(kinect))
        result = LIBUSB_ERROR_NO_DEVICE;
    else if (kinect->faults.deny)
        result = LIBUSB_ERROR_ACCESS;
    if (!result) {
        *handle = calloc(1, sizeof **handle);
        **handle = (libusb_device_handle){device, kinect->plug};
        kinect_log(kinect, "open %s", device_string(device, PRODUCT_STRING));
    }
    bus_unlock();
    return result;
}

int libusb_release_interface(libusb_device_handle *handle, int interface UNUSED)
{
    bus_lock();
    struct kinect *kinect = handle->device->kinect;
    if (kinect->camera_claimed_by == handle)
        kinect->camera_claimed_by = NULL;
    bus_unlock();
    return 0;
}

void libusb_close(libusb_device_handle *handle)
{
    libusb_release_interface(handle, 0);
    bus_lock();
    kinect_log(handle->device->kinect, "close %s", device_string(handle->device, PRODUCT_STRING));
    bus_unlock();
    free(handle);
}

int libusb_claim_interface(libusb_device_handle *handle, int interface UNUSED)
{
    struct kinect *kinect = handle->device->kinect;
    int result = 0;
    bus_lock();
    bool others = kinect->camera_claimed_by && kinect->camera_claimed_by != handle;
    if (!handle_alive(handle))
        result = LIBUSB_ERROR_NO_DEVICE;
    else if (handle->device->function == CAMERA && (kinect->faults.busy || others))
        result = LIBUSB_ERROR_BUSY;
    else if (handle->device->function == CAMERA)
        kinect->camera_claimed_by = handle;
    bus_unlock();
    return result;
}

int libusb_reset_device(libusb_device_handle *handle)
{
    struct kinect *kinect = handle->device->kinect;
    bus_lock();
    bool alive = handle_alive(handle);
    if (alive) {
        kinect_log(kinect, "reset %s", device_string(handle->device, PRODUCT_STRING));
        if (handle->device->function == CAMERA)
            kinect_reset(kinect);
        if (handle->device->function == AUDIO)
            kinect->audio_answer_count = 0;
    }
    bus_unlock();
    return alive ? 0 : LIBUSB_ERROR_NO_DEVICE;
}

libusb_device *libusb_get_device(libusb_device_handle *handle) { return handle->device; }
int libusb_kernel_driver_active(libusb_device_handle *handle UNUSED, int interface UNUSED) { return 0; }
int libusb_detach_kernel_driver(libusb_device_handle *handle UNUSED, int interface UNUSED) { return 0; }
int libusb_attach_kernel_driver(libusb_device_handle *handle UNUSED, int interface UNUSED) { return 0; }
int libusb_set_auto_detach_kernel_driver(libusb_device_handle *handle UNUSED, int on UNUSED) { return 0; }
int libusb_set_interface_alt_setting(libusb_device_handle *handle UNUSED, int interface UNUSED, int alt UNUSED)
{
    return 0;
}
int libusb_set_configuration(libusb_device_handle *handle UNUSED, int configuration UNUSED) { return 0; }
int libusb_clear_halt(libusb_device_handle *handle UNUSED, unsigned char endpoint UNUSED) { return 0; }

int libusb_get_configuration(libusb_device_handle *handle UNUSED, int *configuration)
{
    *configuration = 1;
    return 0;
}

const char *libusb_error_name(int code)
{
    switch (code) {
    case LIBUSB_SUCCESS: return "LIBUSB_SUCCESS";
    case LIBUSB_ERROR_IO: return "LIBUSB_ERROR_IO";
    case LIBUSB_ERROR_ACCESS: return "LIBUSB_ERROR_ACCESS";
    case LIBUSB_ERROR_NO_DEVICE: return "LIBUSB_ERROR_NO_DEVICE";
    case LIBUSB_ERROR_BUSY: return "LIBUSB_ERROR_BUSY";
    case LIBUSB_ERROR_TIMEOUT: return "LIBUSB_ERROR_TIMEOUT";
    case LIBUSB_ERROR_PIPE: return "LIBUSB_ERROR_PIPE";
    default: return "LIBUSB_ERROR_OTHER";
    }
}

const char *libusb_strerror(int code) { return libusb_error_name(code); }
