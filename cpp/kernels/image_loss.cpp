// L1 and structural dissimilarity of two images with the gradient, two passes over rows.
//
// SSIM's map depends on the rendered image x through three blurred images: of x, x^2 and x y. The
// first pass blurs and stores the derivatives of the map by the three; the second blurs those
// (the window is symmetric) and adds the L1 part.
// Source: Wang et al., "Image quality assessment: from error visibility to structural similarity", 2004.
#include "declarations.h"

namespace aomgen::AOMGEN_ISA {

namespace {

constexpr int kReach = 5;  // the window has 11 taps
constexpr int kMargin = 16;  // zeros beside a scratch row, at least kReach
// exp(-k^2 / (2 1.5^2)) for k = -5..5, divided by their sum
constexpr float kWindow[11] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                               0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

struct Rows {
  float* row[5];
};

// Scratch rows with zero margins; row[i][x] is defined for -kMargin <= x < width + kMargin.
Rows make_rows(float* scratch, int width) {
  Rows rows;
  const size_t stride = static_cast<size_t>(width + 64);
  memset(scratch, 0, 5 * stride * sizeof(float));
  for (int i = 0; i < 5; ++i) rows.row[i] = scratch + i * stride + kMargin;
  return rows;
}

AOMGEN_INLINE F load_at(const float* p, int left) { return left >= kLanes ? load(p) : load_first(p, left); }

AOMGEN_INLINE F blur_at(const float* row) {
  F sum = all(kWindow[0]) * load(row - kReach);
  for (int k = 1; k < 11; ++k) sum = fma(all(kWindow[k]), load(row - kReach + k), sum);
  return sum;
}

// Vertical blur of x, y, x^2, y^2 and x y into the scratch rows.
void blur_columns(const float* x, const float* y, float gain, int at, int height, int width, Rows& rows) {
  const int first = at - kReach > 0 ? at - kReach : 0, last = at + kReach < height - 1 ? at + kReach : height - 1;
  for (int column = 0; column < width; column += kLanes) {
    F sums[5] = {zeros(), zeros(), zeros(), zeros(), zeros()};
    for (int v = first; v <= last; ++v) {
      const size_t offset = static_cast<size_t>(v) * width + column;
      F a = gain * load_at(x + offset, width - column), b = load_at(y + offset, width - column);
      F tap = all(kWindow[v - at + kReach]), wa = tap * a, wb = tap * b;
      sums[0] = sums[0] + wa;
      sums[1] = sums[1] + wb;
      sums[2] = fma(wa, a, sums[2]);
      sums[3] = fma(wb, b, sums[3]);
      sums[4] = fma(wa, b, sums[4]);
    }
    for (int i = 0; i < 5; ++i) store_first(rows.row[i] + column, sums[i], width - column < kLanes ? width - column : kLanes);
  }
}

AOMGEN_INLINE double total(F sum) {
  float lanes[kLanes];
  store(lanes, sum);
  double result = 0;
  for (float lane : lanes) result += lane;
  return result;
}

}  // namespace

void ssim_row(const ImageLoss& l, int channel, int at, float* scratch) {
  const size_t plane = static_cast<size_t>(l.height) * l.width, row = static_cast<size_t>(at) * l.width;
  Rows rows = make_rows(scratch, l.width);
  const float gain = l.gains ? l.gains[channel] : 1.0f;
  blur_columns(l.rendered + channel * plane, l.target + channel * plane, gain, at, l.height, l.width, rows);
  float* by_mean = l.maps + channel * plane + row;
  float* by_square = l.maps + (l.channels + channel) * plane + row;
  float* by_product = l.maps + (2 * l.channels + channel) * plane + row;
  F sum = zeros();
  for (int column = 0; column < l.width; column += kLanes) {
    F u = blur_at(rows.row[0] + column), v = blur_at(rows.row[1] + column);
    F uu = u * u, vv = v * v, uv = u * v;
    F means = uu + vv + all(kC1), twice_mean = 2.0f * uv + all(kC1);
    F variances = blur_at(rows.row[2] + column) - uu + blur_at(rows.row[3] + column) - vv + all(kC2);
    F covariance = 2.0f * (blur_at(rows.row[4] + column) - uv) + all(kC2);
    F inverse_means = all(1.0f) / means, inverse_variances = all(1.0f) / variances, both = inverse_means * inverse_variances;
    F ssim = twice_mean * covariance * both;
    F mean_slope = 2.0f * (v * both * (covariance - twice_mean) + u * ssim * (inverse_variances - inverse_means));
    const int width = l.width - column < kLanes ? l.width - column : kLanes;
    store_first(by_mean + column, mean_slope, width);
    store_first(by_square + column, -(ssim * inverse_variances), width);
    store_first(by_product + column, 2.0f * (twice_mean * both), width);
    float lanes[kLanes] = {};
    store_first(lanes, ssim, width);
    sum = sum + load(lanes);
  }
  l.row_ssim[static_cast<size_t>(channel) * l.height + at] = total(sum);
}

void loss_gradient_row(const ImageLoss& l, int channel, int at, float* scratch) {
  const size_t plane = static_cast<size_t>(l.height) * l.width, row = static_cast<size_t>(at) * l.width;
  Rows rows = make_rows(scratch, l.width);
  const int first = at - kReach > 0 ? at - kReach : 0, last = at + kReach < l.height - 1 ? at + kReach : l.height - 1;
  for (int column = 0; column < l.width; column += kLanes) {
    const int width = l.width - column < kLanes ? l.width - column : kLanes;
    for (int i = 0; i < 3; ++i) {
      const float* map = l.maps + (static_cast<size_t>(i) * l.channels + channel) * plane + column;
      F sum = zeros();
      for (int v = first; v <= last; ++v)
        sum = fma(all(kWindow[v - at + kReach]), load_at(map + static_cast<size_t>(v) * l.width, width), sum);
      store_first(rows.row[i] + column, sum, width);
    }
  }
  const float gain = l.gains ? l.gains[channel] : 1.0f;
  const float share = 1.0f / (static_cast<float>(l.channels) * static_cast<float>(plane));
  const F by_l1 = all((1.0f - l.dssim_weight) * share), by_ssim = all(-l.dssim_weight * share);
  const float* x = l.rendered + channel * plane + row;
  const float* y = l.target + channel * plane + row;
  float* out = l.grad_rendered + channel * plane + row;
  F l1 = zeros(), by_gain = zeros();
  for (int column = 0; column < l.width; column += kLanes) {
    const int width = l.width - column < kLanes ? l.width - column : kLanes;
    F drawn = load_at(x + column, width), a = gain * drawn, b = load_at(y + column, width), difference = a - b;
    F slope = blur_at(rows.row[0] + column) + 2.0f * (a * blur_at(rows.row[1] + column)) + b * blur_at(rows.row[2] + column);
    F sign = where(above(difference, zeros()), by_l1) - where(above(zeros(), difference), by_l1);
    F gradient = fma(by_ssim, slope, sign);
    store_first(out + column, gain * gradient, width);
    l1 = l1 + absolute(difference);
    by_gain = fma(gradient, drawn, by_gain);  // lanes past the image hold drawn = difference = 0
  }
  const size_t place = static_cast<size_t>(channel) * l.height + at;
  l.row_l1[place] = total(l1);
  l.row_gain[place] = total(by_gain);
}

}  // namespace aomgen::AOMGEN_ISA
