/* libusb API: device, configuration and string descriptors of the three Kinect models. */
#include "virtual_usb.h"

#include <stdlib.h>

#define UNUSED __attribute__((unused))
#define MICROSOFT 0x045e
#define VENDOR_STRING 2
#define SERIAL_STRING 3
#define K4W_BOOT_LOADER 0x02be
#define NO_SERIAL "0000000000000000" /* what the cameras of later models report */

static const uint16_t PRODUCTS[][FUNCTIONS] = {
    [MODEL_1414] = {0x02ae, 0x02b0, 0x02ad, 0x005a},
    [MODEL_1473] = {0x02ae, 0x02c2, 0x02ad, 0x02c2},
    [MODEL_K4W] = {0x02bf, 0x02c2, 0x02c3, 0x02c2},
};

static bool camera_without_serial(const struct libusb_device *device)
{
    return device->function == CAMERA && device->kinect->model != MODEL_1414;
}

const char *device_string(const struct libusb_device *device, int index)
{
    static const char *const products[] = {"Xbox NUI Camera", "Xbox NUI Motor", "Xbox NUI Audio", "Hub"};
    switch (index) {
    case PRODUCT_STRING:
        return products[device->function];
    case VENDOR_STRING:
        return "Microsoft";
    case SERIAL_STRING:
        return camera_without_serial(device) ? NO_SERIAL : device->kinect->serial;
    default:
        return NULL;
    }
}

int libusb_get_device_descriptor(libusb_device *device, struct libusb_device_descriptor *descriptor)
{
    enum model model = device->kinect->model;
    bool boots = model == MODEL_K4W && device->function == AUDIO && !device->kinect->audio_firmware;
    *descriptor = (struct libusb_device_descriptor){
        .bLength = LIBUSB_DT_DEVICE_SIZE,
        .bDescriptorType = LIBUSB_DT_DEVICE,
        .bcdUSB = 0x200,
        .bMaxPacketSize0 = 64,
        .idVendor = MICROSOFT,
        .idProduct = boots ? K4W_BOOT_LOADER : PRODUCTS[model][device->function],
        .bcdDevice = model == MODEL_1414 ? 0x010b : 0x0200, /* how drivers tell the models apart */
        .iProduct = PRODUCT_STRING,
        .iManufacturer = VENDOR_STRING,
        .iSerialNumber = device->function == MOTOR ? 0 : SERIAL_STRING,
        .bNumConfigurations = 1,
    };
    return 0;
}

#define ISOCHRONOUS 1
#define BULK 2
#define ENDPOINT(kind, address, size)                                                                     \
    {.bLength = 7, .bDescriptorType = 5, .bmAttributes = kind, .bInterval = 1, .bEndpointAddress = address, \
     .wMaxPacketSize = size}
#define INTERFACE(number, ...)                                                                      \
    {.bLength = 9, .bDescriptorType = 4, .bInterfaceClass = 0xff, .bInterfaceNumber = number, __VA_ARGS__}

static const struct libusb_endpoint_descriptor CAMERA_ENDPOINTS[STREAMS] = {
    ENDPOINT(ISOCHRONOUS, 0x81, 0x0bc0),
    ENDPOINT(ISOCHRONOUS, 0x82, 0x0be0),
};
static const struct libusb_endpoint_descriptor AUDIO_ENDPOINTS[2] = {
    ENDPOINT(BULK, 0x01, 512),
    ENDPOINT(BULK, 0x81, 512),
};
static const struct libusb_interface_descriptor INTERFACES[] = {
    INTERFACE(0, .bNumEndpoints = STREAMS, .endpoint = CAMERA_ENDPOINTS),
    INTERFACE(0),
    INTERFACE(0, .bNumEndpoints = 2, .endpoint = AUDIO_ENDPOINTS),
    INTERFACE(1),
};
static const struct libusb_interface CAMERA_INTERFACES[] = {{&INTERFACES[0], 1}};
static const struct libusb_interface MOTOR_INTERFACES[] = {{&INTERFACES[1], 1}};
static const struct libusb_interface AUDIO_INTERFACES[] = {{&INTERFACES[2], 1}, {&INTERFACES[3], 1}};

int libusb_get_config_descriptor(
    libusb_device *device, uint8_t index UNUSED, struct libusb_config_descriptor **out)
{
    static const struct libusb_interface *const interfaces[HUB] = {
        [CAMERA] = CAMERA_INTERFACES, [MOTOR] = MOTOR_INTERFACES, [AUDIO] = AUDIO_INTERFACES,
    };
    bool firmware = device->function == AUDIO && device->kinect->audio_firmware;
    struct libusb_config_descriptor *config = calloc(1, sizeof *config);
    *config = (struct libusb_config_descriptor){
        .bLength = 9,
        .bDescriptorType = 2,
        .bNumInterfaces = firmware ? 2 : 1, /* as libfreenect tells whether it is loaded */
        .bConfigurationValue = 1,
        .MaxPower = 8,
        .interface = interfaces[device->function],
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
