// One device: its sensors, its serial number, registration of depth to colour.
#include "virtual_device.hpp"

#include <cstring>

VirtualDevice::VirtualDevice(const Folder& folder, double fps) : folder_(folder), clock_(folder, fps) {
    folder_.log("open");
    std::vector<OniSensorType> types;
    if (folder_.has("depth.bin"))
        types.push_back(ONI_SENSOR_DEPTH);
    if (folder_.has("color.bin"))
        types.push_back(ONI_SENSOR_COLOR);
    for (OniSensorType type : types)
        modes_.push_back(VirtualStream::mode_of(type, folder_, fps));
    for (size_t i = 0; i < types.size(); i++)
        sensors_.push_back(OniSensorInfo{types[i], 1, &modes_[i]});
}

OniStatus VirtualDevice::getSensorInfoList(OniSensorInfo** sensors, int* count) {
    *sensors = sensors_.data();
    *count = static_cast<int>(sensors_.size());
    return ONI_STATUS_OK;
}

oni::driver::StreamBase* VirtualDevice::createStream(OniSensorType type) {
    for (const OniSensorInfo& sensor : sensors_)
        if (sensor.sensorType == type)
            return new VirtualStream(type, folder_, clock_, registered_);
    return nullptr;
}

OniBool VirtualDevice::isPropertySupported(int property) {
    switch (property) {
    case ONI_DEVICE_PROPERTY_SERIAL_NUMBER:
        return folder_.has("serial");
    case ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION:
        return folder_.has("registered.bin");
    default:
        return FALSE;
    }
}

OniStatus VirtualDevice::getProperty(int property, void* data, int* size) {
    if (!isPropertySupported(property))
        return ONI_STATUS_NOT_SUPPORTED;
    if (property == ONI_DEVICE_PROPERTY_SERIAL_NUMBER) {
        const std::string serial = folder_.text("serial", "");
        if (*size <= static_cast<int>(serial.size()))
            return ONI_STATUS_BAD_PARAMETER;
        *size = static_cast<int>(serial.size()) + 1;
        std::memcpy(data, serial.c_str(), serial.size() + 1);
        return ONI_STATUS_OK;
    }
    const OniImageRegistrationMode mode =
        registered_ ? ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR : ONI_IMAGE_REGISTRATION_OFF;
    if (*size != static_cast<int>(sizeof mode))
        return ONI_STATUS_BAD_PARAMETER;
    std::memcpy(data, &mode, sizeof mode);
    return ONI_STATUS_OK;
}

OniStatus VirtualDevice::setProperty(int property, const void* data, int size) {
    if (property != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION || !isPropertySupported(property) ||
        size != static_cast<int>(sizeof(OniImageRegistrationMode)))
        return ONI_STATUS_NOT_SUPPORTED;
    registered_ = *static_cast<const OniImageRegistrationMode*>(data) == ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR;
    folder_.log(registered_ ? "registration on" : "registration off");
    return ONI_STATUS_OK;
}

OniBool VirtualDevice::isImageRegistrationModeSupported(OniImageRegistrationMode mode) {
    return mode == ONI_IMAGE_REGISTRATION_OFF || folder_.has("registered.bin");
}
