// Pictures for comparing one machine with another.
#pragma once

namespace aomgen::tests {

// Draws scenes with the baseline kernels and writes images and gradients as named float32 arrays.
bool write_images(const char* path);

// Prints how far two such files differ. True where pictures are the same within 1e-5 but for a few
// numbers (a splat at the edge of visibility may be drawn by one and not by the other), and
// gradients within 1e-5 of the largest on average.
bool same_images(const char* path, const char* other);

}  // namespace aomgen::tests
