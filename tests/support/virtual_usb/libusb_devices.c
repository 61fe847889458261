/* libusb API: contexts, enumeration, descriptors, handles.
 *
 * Kinect n sits at port n+1 of bus 1: a hub with the camera, the motor and the audio device on its
 * ports 1, 2 and 3. The hub itself is not listed.
 */
#include "virtual_usb.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define UNUSED __attribute__((unused))
#define MICROSOFT 0x045e
#define BUS_NUMBER 1
#define FIRST_VENDOR_STRING 1
#define NO_SERIAL "0000000000000000" /* what the cameras of later models report */

static const uint16_t PRODUCTS[][FUNCTIONS] = {
    [MODEL_1414] = {0x02ae, 0x02b0, 0x02ad, 0x005a},
    [MODEL_1473] = {0x02ae, 0x02c2, 0x02ad, 0x02c2},
    [MODEL_K4W] = {0x02bf, 0x02c2, 0x02c3, 0x02c2},
};

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

static bool camera_without_serial(const struct libusb_device *device)
{
    return device->function == CAMERA && device->kinect->model != MODEL_1414;
}

const char *device_string(const struct libusb_device *device, int index)
{
    static const char *const products[] = {"Xbox NUI Camera", "Xbox NUI Motor", "Xbox NUI Audio", "Hub"};
    switch (index) {
    case FIRST_VENDOR_STRING:
        return products[device->function];
    case 2:
        return "Microsoft";
    case 3:
        return camera_without_serial(device) ? NO_SERIAL : device->kinect->serial;
    default:
        return NULL;
    }
}

int libusb_get_device_descriptor(libusb_device *device, struct libusb_device_descriptor *descriptor)
{
    enum model model = device->kinect->model;
    *descriptor = (struct libusb_device_descriptor){
        .bLength = LIBUSB_DT_DEVICE_SIZE,
        .bDescriptorType = LIBUSB_DT_DEVICE,
        .bcdUSB = 0x200,
        .bMaxPacketSize0 = 64,
        .idVendor = MICROSOFT,
        .idProduct = PRODUCTS[model][device->function],
        .bcdDevice = model == MODEL_1414 ? 0x010b : 0x0200, /* how drivers tell the models apart */
        .iProduct = FIRST_VENDOR_STRING,
        .iManufacturer = 2,
        .iSerialNumber = device->function == MOTOR ? 0 : 3,
        .bNumConfigurations = 1,
    };
    return 0;
}

#define ENDPOINT(address, size)                                                                        \
    {.bLength = 7, .bDescriptorType = 5, .bmAttributes = 1, .bInterval = 1, .bEndpointAddress = address, \
     .wMaxPacketSize = size}
#define INTERFACE(number, ...)                                                                      \
    {.bLength = 9, .bDescriptorType = 4, .bInterfaceClass = 0xff, .bInterfaceNumber = number, __VA_ARGS__}

static const struct libusb_endpoint_descriptor CAMERA_ENDPOINTS[STREAMS] = {
    ENDPOINT(0x81, 0x0bc0),
    ENDPOINT(0x82, 0x0be0),
};
static const struct libusb_interface_descriptor INTERFACES[] = {
    INTERFACE(0, .bNumEndpoints = STREAMS, .endpoint = CAMERA_ENDPOINTS),
    INTERFACE(0),
    INTERFACE(1),
};
static const struct libusb_interface CAMERA_INTERFACES[] = {{&INTERFACES[0], 1}};
static const struct libusb_interface OTHER_INTERFACES[] = {{&INTERFACES[1], 1}, {&INTERFACES[2], 1}};

int libusb_get_config_descriptor(
    libusb_device *device, uint8_t index UNUSED, struct libusb_config_descriptor **out)
{
    struct libusb_config_descriptor *config = calloc(1, sizeof *config);
    *config = (struct libusb_config_descriptor){
        .bLength = 9,
        .bDescriptorType = 2,
        .bNumInterfaces = device->function == AUDIO ? 2 : 1, /* two: its firmware is loaded */
        .bConfigurationValue = 1,
        .MaxPower = 8,
        .interface = device->function == CAMERA ? CAMERA_INTERFACES : OTHER_INTERFACES,
    };
    *out = config;
    return 0;
}

int libusb_get_active_config_descriptor(libusb_device *device, struct libusb_config_descriptor **out)
{
    return libusb_get_config_descriptor(device, 0, out);
}

void libusb_free_config_descriptor(struct libusb_config_descriptor *config) { free(config); }

int libusb_get_max_iso_packet_size(libusb_device *device UNUSED, unsigned char endpoint)
{
    return endpoint == CAMERA_ENDPOINTS[VIDEO].bEndpointAddress ? 1920 : 1760;
}

int libusb_get_max_packet_size(libusb_device *device, unsigned char endpoint)
{
    return libusb_get_max_iso_packet_size(device, endpoint);
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
        kinect_log(kinect, "open %s", device_string(device, FIRST_VENDOR_STRING));
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
    kinect_log(handle->device->kinect, "close %s", device_string(handle->device, FIRST_VENDOR_STRING));
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
        kinect_log(kinect, "reset %s", device_string(handle->device, FIRST_VENDOR_STRING));
        if (handle->device->function == CAMERA)
            kinect_reset(kinect);
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
