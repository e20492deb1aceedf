// Memory that grows and is used again; contents are not kept when it grows.
#pragma once

#include <cstddef>
#include <cstdlib>
#include <new>

namespace aomgen {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { std::free(data_); }

  // At least `count` elements on a cache line boundary; throws std::bad_alloc.
  T* reserve(size_t count) {
    if (count <= capacity_ && data_) return data_;
    std::free(data_);
    data_ = nullptr;
    capacity_ = count + count / 4 + 64;
    const size_t bytes = (capacity_ * sizeof(T) + 63) / 64 * 64;
    data_ = static_cast<T*>(std::aligned_alloc(64, bytes));
    if (!data_) {
      capacity_ = 0;
      throw std::bad_alloc();
    }
    return data_;
  }
  T* data() { return data_; }
  const T* data() const { return data_; }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace aomgen
