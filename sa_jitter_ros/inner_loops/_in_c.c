// Copyright 2026 sa_jitter_ros contributors
//
// Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
// in compliance with the License. You may obtain a copy of the License at
// http://www.apache.org/licenses/LICENSE-2.0
// Unless required by applicable law or agreed to in writing, software distributed under the License
// is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
// or implied. See the License for the specific language governing permissions and limitations under
// the License.

/* The loops over all samples: what in_numpy.py does where this is not compiled.
 *
 * What is added up stays in registers, where numpy and scipy load and store it once for each
 * number, and each array is read once.
 */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* One version for each width of vectors; the loader takes the widest that the processor has. */
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__) && __GNUC__ >= 12
#define FOR_EACH_PROCESSOR \
    __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FOR_EACH_PROCESSOR
#endif

#define INLINE static inline __attribute__((always_inline))

/* Neighbouring numbers, at any address. */
typedef double eight __attribute__((vector_size(64), aligned(8), may_alias));
typedef double aligned __attribute__((vector_size(64), may_alias));
typedef double four __attribute__((vector_size(32), aligned(8), may_alias));
typedef double two __attribute__((vector_size(16), aligned(8), may_alias));
typedef double one __attribute__((may_alias));

INLINE double total(eight sum)
{
    return ((sum[0] + sum[4]) + (sum[2] + sum[6])) + ((sum[1] + sum[5]) + (sum[3] + sum[7]));
}

/* --- what arrays are given --- */

static int is_array(const Py_buffer *view, int dimensions, char type, Py_ssize_t size)
{
    return view->ndim == dimensions && view->itemsize == size && view->format[0] == type
           && view->format[1] == 0;
}

/* The numbers of an item lie one behind the other; items may be further apart. */
static int is_list(const Py_buffer *view, int least)
{
    Py_ssize_t step = sizeof(double);
    if (view->ndim < least || !is_array(view, view->ndim, 'd', 8))
        return 0;
    for (int k = view->ndim - 1; k > 0; step *= view->shape[k--])
        if (view->shape[k] != 1 && view->strides[k] != step)
            return 0;
    return 1;
}

/* How many numbers are in the dimensions from `first` on. */
static Py_ssize_t size_from(const Py_buffer *view, int first)
{
    Py_ssize_t size = 1;
    for (int k = first; k < view->ndim; k++)
        size *= view->shape[k];
    return size;
}

/* Take `count` arrays with these flags, the last `written` of them to be written; 0 for an error. */
static int take_arrays(PyObject *const *given, Py_ssize_t number, int count, int written,
                       int flags, Py_buffer *views)
{
    int held = 0;
    if (number != count) {
        PyErr_Format(PyExc_TypeError, "%d arrays are needed", count);
        return 0;
    }
    while (held < count && PyObject_GetBuffer(
               given[held], &views[held],
               flags | PyBUF_FORMAT | (held >= count - written ? PyBUF_WRITABLE : 0)) == 0)
        held++;
    if (held == count)
        return 1;
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    return 0;
}

/* Give the arrays back; return `result`, NULL for an error, which is that they do not fit. */
static PyObject *give_back(Py_buffer *views, int count, int fitted, PyObject *result)
{
    while (count > 0)
        PyBuffer_Release(&views[--count]);
    if (fitted)
        return Py_NewRef(result);
    if (!PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "the arrays do not fit each other");
    return NULL;
}

/* --- weighted sums: of samples, whose weights are polynomials --- */

/* The sums of some neighbouring channels, in four parts that do not wait for each other. */
#define ADD_UP(type) do { \
    const type zero = {0.0}; \
    type sum[4] = {zero, zero, zero, zero}; \
    const double *row = first + c; \
    Py_ssize_t k = 0; \
    for (; k + 4 <= taps; k += 4, row += 4 * channels) { \
        sum[0] += weights[k] * *(const type *)row; \
        sum[1] += weights[k + 1] * *(const type *)(row + channels); \
        sum[2] += weights[k + 2] * *(const type *)(row + 2 * channels); \
        sum[3] += weights[k + 3] * *(const type *)(row + 3 * channels); \
    } \
    for (; k < taps; k++, row += channels) \
        sum[0] += weights[k] * *(const type *)row; \
    *(type *)(values + c) = (sum[0] + sum[1]) + (sum[2] + sum[3]); \
} while (0)

/* Samples from the first of a sum to what is fetched from the memory, which takes that long. */
#define AHEAD 64

/* Places of the sums: `count` u in each of the rows. */
struct places {
    const int32_t *origin;
    const double *begin, *length, *u;
    Py_ssize_t rows, count;
};

/* `table` holds the polynomials of the first half of the weights, the lowest power first, in rows
 * of `width` numbers that begin at a multiple of 64 bytes: zeros and the `half`; `room` is that of
 * the weights between as many zeros. Weights of the second half are those of the first, in the
 * other order, with the odd powers taken away. Returns 0 if a sum is not within the samples, of
 * which it may begin at the `last`. */
INLINE int sums(const double *samples, const Py_ssize_t channels, Py_ssize_t last,
                const struct places *at, const double *restrict table, double *restrict room,
                const Py_ssize_t order, const Py_ssize_t half, double *restrict values)
{
    typedef int64_t lanes __attribute__((vector_size(64)));
    const lanes turned = {7, 6, 5, 4, 3, 2, 1, 0};
    const Py_ssize_t width = (half + 7) / 8 * 8;
    const double *weights = room + width - half;
    const struct places p = *at;
    const Py_ssize_t size = p.rows * p.count, taps = 2 * half;
    for (Py_ssize_t i = 0, row = 0, column = 0; i < size; i++, values += channels) {
        const double place = p.begin[row] + p.length[row] * p.u[column];
        if (!(place >= 0.0 && place <= INT32_MAX))
            return 0;
        const int32_t whole = (int32_t)place;
        const Py_ssize_t index = p.origin[row] + (Py_ssize_t)whole;
        if (index < 0 || index > last)
            return 0;
        if (++column == p.count) {
            column = 0;
            row++;
        }
        const double *first = samples + index * channels;
        const double x = 2.0 * (place - whole) - 1.0, square = x * x;
        Py_ssize_t t, c = 0;
        for (t = 0; t < width; t += 8) {
            const double *power = table + (order - 2) * width + t;
            eight even = *(const aligned *)power, odd = *(const aligned *)(power + width);
            for (Py_ssize_t k = order - 2; k > 0; k -= 2) {
                power -= 2 * width;
                even = even * square + *(const aligned *)power;
                odd = odd * square + *(const aligned *)(power + width);
            }
            odd *= x;
            const eight second = even - odd;
            *(aligned *)(room + t) = even + odd;
            *(aligned *)(room + 2 * width - 8 - t) = __builtin_shuffle(second, turned);
        }
        if (channels == 1) {
            eight sum = {0.0};
            for (t = 0; t + 8 <= taps; t += 8)
                sum += *(const eight *)(weights + t) * *(const eight *)(first + t);
            for (; t < taps; t++)
                sum[t % 8] += weights[t] * first[t];
            *values = total(sum);
            continue;
        }
        for (; c + 8 <= channels; c += 8) {
            __builtin_prefetch(first + AHEAD * channels + c);
            ADD_UP(eight);
        }
        for (; c + 4 <= channels; c += 4)
            ADD_UP(four);
        for (; c + 2 <= channels; c += 2)
            ADD_UP(two);
        for (; c < channels; c++)
            ADD_UP(one);
    }
    return 1;
}

/* What is known to the compiler stays in registers: the default interpolator, one channel. */
FOR_EACH_PROCESSOR
static int weighted_sums(const double *samples, Py_ssize_t channels, Py_ssize_t last,
                         const struct places *at, const double *table, double *room,
                         Py_ssize_t order, Py_ssize_t half, double *values)
{
    if (order == 8 && half == 8 && channels == 1)
        return sums(samples, 1, last, at, table, room, 8, 8, values);
    if (order == 8 && half == 8)
        return sums(samples, channels, last, at, table, room, 8, 8, values);
    return sums(samples, channels, last, at, table, room, order, half, values);
}

static int fit(const Py_buffer *samples, const Py_buffer *origin, const Py_buffer *begin,
               const Py_buffer *length, const Py_buffer *u, const Py_buffer *polynomials,
               const Py_buffer *values)
{
    return is_array(samples, 2, 'd', 8) && is_array(origin, 1, 'i', 4)
        && is_array(begin, 1, 'd', 8) && is_array(length, 1, 'd', 8) && is_array(u, 1, 'd', 8)
        && is_array(polynomials, 2, 'd', 8) && is_array(values, 2, 'd', 8)
        && begin->shape[0] == origin->shape[0] && length->shape[0] == origin->shape[0]
        && values->shape[0] == origin->shape[0] * u->shape[0]
        && values->shape[1] == samples->shape[1] && polynomials->shape[0] > 0
        && polynomials->shape[1] > 0;
}

/* Return whether all sums are within the samples; -1 where there is no memory. */
static int compute(Py_buffer *views)
{
    const Py_ssize_t powers = views[5].shape[0], half = views[5].shape[1];
    const Py_ssize_t order = (powers + 1) / 2 * 2, width = (half + 7) / 8 * 8;
    const struct places at = {views[1].buf, views[2].buf, views[3].buf, views[4].buf,
                              views[1].shape[0], views[4].shape[0]};
    const double *polynomials = views[5].buf;
    double *table = aligned_alloc(64, (order + 2) * width * sizeof(double));
    if (table == NULL)
        return -1;
    memset(table, 0, (order + 2) * width * sizeof(double));
    for (Py_ssize_t k = 0; k < powers; k++)
        memcpy(table + (k + 1) * width - half, polynomials + k * half, half * sizeof(double));
    const int inside = weighted_sums(views[0].buf, views[0].shape[1],
                                     views[0].shape[0] - 2 * half, &at, table,
                                     table + order * width, order, half, views[6].buf);
    free(table);
    return inside;
}

static PyObject *take_weighted_sums(PyObject *self, PyObject *const *given, Py_ssize_t number)
{
    (void)self;
    Py_buffer views[7];
    int done = 0;
    if (!take_arrays(given, number, 7, 1, PyBUF_C_CONTIGUOUS, views))
        return NULL;
    if (fit(&views[0], &views[1], &views[2], &views[3], &views[4], &views[5], &views[6])) {
        Py_BEGIN_ALLOW_THREADS
        done = compute(views);
        Py_END_ALLOW_THREADS
    }
    if (done < 0)
        PyErr_NoMemory();
    return give_back(views, 7, done > 0, Py_None);
}

/* --- frames: samples (channel, n) to (n, channel), whether all are finite --- */

#define EXCHANGE(a, b, low, high) do { \
    const eight first = a, second = b; \
    a = __builtin_shuffle(first, second, low); \
    b = __builtin_shuffle(first, second, high); \
} while (0)

/* Eight samples of eight channels. */
INLINE void transpose(eight *row)
{
    typedef int64_t places __attribute__((vector_size(64)));
    const places low1 = {0, 8, 2, 10, 4, 12, 6, 14}, high1 = {1, 9, 3, 11, 5, 13, 7, 15};
    const places low2 = {0, 1, 8, 9, 4, 5, 12, 13}, high2 = {2, 3, 10, 11, 6, 7, 14, 15};
    const places low4 = {0, 1, 2, 3, 8, 9, 10, 11}, high4 = {4, 5, 6, 7, 12, 13, 14, 15};
    for (int k = 0; k < 8; k += 2)
        EXCHANGE(row[k], row[k + 1], low1, high1);
    for (int k = 0; k < 8; k++)
        if (!(k & 2))
            EXCHANGE(row[k], row[k + 2], low2, high2);
    for (int k = 0; k < 4; k++)
        EXCHANGE(row[k], row[k + 4], low4, high4);
}

/* Steps are in bytes. What is not finite makes the sum of 0 times all numbers NaN. */
FOR_EACH_PROCESSOR
static int frames(const char *samples, Py_ssize_t channels, Py_ssize_t count,
                  Py_ssize_t channel_step, Py_ssize_t step, double *values)
{
    const Py_ssize_t many = step == sizeof(double) ? channels / 8 * 8 : 0, tile = 2048;
    eight zero = {0.0}, row[8];
    double sum = 0.0;
    for (Py_ssize_t begin = 0; begin < count; begin += tile) {
        const Py_ssize_t end = begin + tile < count ? begin + tile : count;
        for (Py_ssize_t c = 0; c < channels; c += c < many ? 8 : 1) {
            const char *first = samples + c * channel_step;
            Py_ssize_t s = begin;
            for (; c < many && s + 8 <= end; s += 8) {
                for (int k = 0; k < 8; k++) {
                    row[k] = *(const eight *)(first + k * channel_step + s * step);
                    zero += row[k] * 0.0;
                }
                transpose(row);
                for (int k = 0; k < 8; k++)
                    *(eight *)(values + (s + k) * channels + c) = row[k];
            }
            for (; s < end; s++)
                for (Py_ssize_t k = 0; k < (c < many ? 8 : 1); k++) {
                    const double value = *(const double *)(first + k * channel_step + s * step);
                    values[s * channels + c + k] = value;
                    sum += value * 0.0;
                }
        }
    }
    return sum + total(zero) == 0.0;
}

/* Samples that are in the order of frames. */
FOR_EACH_PROCESSOR
static int copied(const double *samples, Py_ssize_t count, double *values)
{
    eight zero = {0.0};
    Py_ssize_t i = 0;
    for (; i + 8 <= count; i += 8) {
        const eight part = *(const eight *)(samples + i);
        *(eight *)(values + i) = part;
        zero += part * 0.0;
    }
    for (; i < count; i++) {
        values[i] = samples[i];
        zero[0] += samples[i] * 0.0;
    }
    return total(zero) == 0.0;
}

static PyObject *take_frames(PyObject *self, PyObject *const *given, Py_ssize_t number)
{
    (void)self;
    Py_buffer views[2], *samples = &views[0], *values = &views[1];
    int finite = 0;
    if (!take_arrays(given, number, 2, 1, PyBUF_STRIDES, views))
        return NULL;
    const int fitted = is_array(samples, 2, 'd', 8) && is_array(values, 2, 'd', 8)
        && is_list(values, 2) && values->shape[0] == samples->shape[1]
        && values->shape[1] == samples->shape[0]
        && (values->shape[0] < 2 || values->strides[0] == 8 * values->shape[1]);
    if (fitted) {
        const Py_ssize_t channels = samples->shape[0], count = samples->shape[1];
        const Py_ssize_t channel_step = samples->strides[0], step = samples->strides[1];
        Py_BEGIN_ALLOW_THREADS
        if ((channels == 1 || channel_step == 8) && step == 8 * channels)
            finite = copied(samples->buf, channels * count, values->buf);
        else
            finite = frames(samples->buf, channels, count, channel_step, step, values->buf);
        Py_END_ALLOW_THREADS
    }
    return give_back(views, 2, fitted, finite ? Py_True : Py_False);
}

/* --- add steps: from the first of some arrays to all of them, and their squares --- */

#define ADD_STEPS(type) do { \
    const type begin = *(const type *)(first + i); \
    type step = {0.0}, total = step, power = step; \
    for (Py_ssize_t k = 0; k < count; k++) { \
        step = *(const type *)(values + k * apart + i * sizeof(double)) - begin; \
        total += step; \
        power += step * step; \
    } \
    *(type *)(sum + i) += total; \
    *(type *)(squares + i) += power; \
} while (0)

/* The arrays are `apart` bytes from each other. */
FOR_EACH_PROCESSOR
static void add_steps(const char *values, Py_ssize_t count, Py_ssize_t apart, Py_ssize_t size,
                      const double *first, double *sum, double *squares)
{
    Py_ssize_t i = 0;
    for (; i + 8 <= size; i += 8)
        ADD_STEPS(eight);
    for (; i < size; i++)
        ADD_STEPS(one);
}

static PyObject *take_steps(PyObject *self, PyObject *const *given, Py_ssize_t number)
{
    (void)self;
    Py_buffer views[4];
    int fitted = 1;
    if (!take_arrays(given, number, 4, 2, PyBUF_STRIDES, views))
        return NULL;
    const Py_ssize_t size = size_from(&views[0], 1);
    for (int k = 0; k < 4; k++)
        fitted = fitted && is_list(&views[k], 1) && size_from(&views[k], k == 0) == size
            && (!k || views[k].shape[0] < 2
                || views[k].strides[0] == 8 * size_from(&views[k], 1));
    if (fitted) {
        Py_BEGIN_ALLOW_THREADS
        add_steps(views[0].buf, views[0].shape[0], views[0].strides[0], size, views[1].buf,
                  views[2].buf, views[3].buf);
        Py_END_ALLOW_THREADS
    }
    return give_back(views, 4, fitted, Py_None);
}

/* --- add products: of a table with the rows of some arrays --- */

/* Some lines of the table; the compiler knows how many, and keeps their sums in registers. */
INLINE void some_lines(const int lines, const double *table, Py_ssize_t apart, Py_ssize_t rows,
                       const double *values, Py_ssize_t size, double *sums)
{
    Py_ssize_t i = 0;
    for (; i + 16 <= size; i += 16) {
        eight sum[6][2];
        for (int j = 0; j < lines; j++)
            for (int h = 0; h < 2; h++)
                sum[j][h] = *(const eight *)(sums + j * size + i + 8 * h);
        for (Py_ssize_t r = 0; r < rows; r++)
            for (int h = 0; h < 2; h++) {
                const eight value = *(const eight *)(values + r * size + i + 8 * h);
                for (int j = 0; j < lines; j++)
                    sum[j][h] += table[j * apart + r] * value;
            }
        for (int j = 0; j < lines; j++)
            for (int h = 0; h < 2; h++)
                *(eight *)(sums + j * size + i + 8 * h) = sum[j][h];
    }
    for (; i < size; i++)
        for (Py_ssize_t r = 0; r < rows; r++)
            for (int j = 0; j < lines; j++)
                sums[j * size + i] += table[j * apart + r] * values[r * size + i];
}

/* The lines of the table are `apart` numbers from each other. */
FOR_EACH_PROCESSOR
static void add_products(const double *table, Py_ssize_t lines, Py_ssize_t apart, Py_ssize_t rows,
                         const double *values, Py_ssize_t size, double *sums)
{
    for (; lines >= 6; lines -= 6, table += 6 * apart, sums += 6 * size)
        some_lines(6, table, apart, rows, values, size, sums);
    for (; lines >= 2; lines -= 2, table += 2 * apart, sums += 2 * size)
        some_lines(2, table, apart, rows, values, size, sums);
    if (lines)
        some_lines(1, table, apart, rows, values, size, sums);
}

static PyObject *take_products(PyObject *self, PyObject *const *given, Py_ssize_t number)
{
    (void)self;
    Py_buffer views[3], *table = &views[0], *values = &views[1], *sums = &views[2];
    if (!take_arrays(given, number, 3, 1, PyBUF_STRIDES, views))
        return NULL;
    const int fitted = is_list(table, 2) && table->ndim == 2 && is_list(values, 3)
        && values->ndim == 3 && is_list(sums, 3) && sums->ndim == 3
        && values->shape[1] == table->shape[1] && sums->shape[0] == values->shape[0]
        && sums->shape[1] == table->shape[0] && sums->shape[2] == values->shape[2]
        && table->strides[0] % 8 == 0;
    if (fitted) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t k = 0; k < values->shape[0]; k++)
            add_products(table->buf, table->shape[0], table->strides[0] / 8, table->shape[1],
                         (const double *)((char *)values->buf + k * values->strides[0]),
                         values->shape[2],
                         (double *)((char *)sums->buf + k * sums->strides[0]));
        Py_END_ALLOW_THREADS
    }
    return give_back(views, 3, fitted, Py_None);
}

#define METHOD(name, function, text) \
    {name, (PyCFunction)(void (*)(void))function, METH_FASTCALL, text}

static PyMethodDef methods[] = {
    METHOD("weighted_sums", take_weighted_sums,
           "weighted_sums(samples, origin, begin, length, u, polynomials, values)\n--\n\n"
           "See in_numpy. Raises ValueError for sums beyond the samples."),
    METHOD("frames", take_frames, "frames(samples, values)\n--\n\nSee in_numpy."),
    METHOD("add_steps", take_steps,
           "add_steps(values, first, sum, squares)\n--\n\nSee in_numpy."),
    METHOD("add_products", take_products,
           "add_products(table, values, sums)\n--\n\nSee in_numpy."),
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_in_c", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__in_c(void)
{
    return PyModule_Create(&module);
}
