#include <cmath>
#include <cstdio>
#include <hdf5.h>
#include <vector>

template <class T> std::vector<T> first(hid_t file, const char* name, hid_t type, hsize_t& h, hsize_t& w) {
    hid_t set = H5Dopen2(file, name, H5P_DEFAULT), space = H5Dget_space(set);
    hsize_t dims[3], start[3] = {0, 0, 0};
    H5Sget_simple_extent_dims(space, dims, nullptr);
    h = dims[1], w = dims[2];
    hsize_t count[3] = {1, h, w};
    std::vector<T> out(h * w);
    H5Sselect_hyperslab(space, H5S_SELECT_SET, start, nullptr, count, nullptr);
    hid_t memory = H5Screate_simple(3, count, nullptr);
    H5Dread(set, type, memory, space, H5P_DEFAULT, out.data());
    H5Sclose(memory), H5Sclose(space), H5Dclose(set);
    return out;
}

int main(int, char** argv) {
    hid_t file = H5Fopen(argv[1], H5F_ACC_RDONLY, H5P_DEFAULT);
    hsize_t h, w;
    auto sensor = first<float>(file, "tof/depth", H5T_NATIVE_FLOAT, h, w);
    auto truth = first<float>(file, "gt/depth_1x", H5T_NATIVE_FLOAT, h, w);
    auto mask = first<unsigned char>(file, "gt/mask_1x", H5T_NATIVE_UCHAR, h, w);
    double sum = 0, n = 0;
    for (hsize_t i = 0; i < h * w; ++i)
        if (mask[i] == 0 && std::isfinite(sensor[i])) sum += std::fabs(sensor[i] - truth[i]), ++n;
    std::printf("%.2f mm\n", 1e3 * sum / n);
    H5Fclose(file);
}
