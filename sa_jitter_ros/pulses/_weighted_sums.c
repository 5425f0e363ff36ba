// Copyright 2026 sa_jitter_ros contributors
//
// Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
// in compliance with the License. You may obtain a copy of the License at
// http://www.apache.org/licenses/LICENSE-2.0
// Unless required by applicable law or agreed to in writing, software distributed under the License
// is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
// or implied. See the License for the specific language governing permissions and limitations under
// the License.

/* The inner loop of resampling.py: weighted sums of samples, whose weights are polynomials.
 *
 * scipy's sparse product, which weighted_sums.py uses where this is not compiled, loads and stores
 * every sum once for each weight. Here the sums of some channels stay in registers, and so do the
 * weights while they are computed.
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

/* Neighbouring numbers, at any address. */
typedef double eight __attribute__((vector_size(64), aligned(8), may_alias));
typedef double aligned __attribute__((vector_size(64), may_alias));
typedef double four __attribute__((vector_size(32), aligned(8), may_alias));
typedef double two __attribute__((vector_size(16), aligned(8), may_alias));
typedef double one __attribute__((may_alias));

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

/* `table` holds the polynomials, the highest power first, and room for the weights. Each of its
 * rows begins at a multiple of 64 bytes and has `width` numbers, the taps and zeros behind them. */
FOR_EACH_PROCESSOR
static void weighted_sums(const double *samples, Py_ssize_t channels, const int32_t *begin,
                          const double *fraction, Py_ssize_t count, double *table,
                          Py_ssize_t order, Py_ssize_t taps, Py_ssize_t width, double *values)
{
    double *weights = table + order * width;
    for (Py_ssize_t i = 0; i < count; i++, values += channels) {
        const double *first = samples + begin[i] * channels;
        const double x = 2.0 * fraction[i] - 1.0;
        Py_ssize_t t, c = 0;
        for (t = 0; t < width; t += 8) {
            eight sum = *(const aligned *)(table + t);
            for (Py_ssize_t k = 1; k < order; k++)
                sum = sum * x + *(const aligned *)(table + k * width + t);
            *(aligned *)(weights + t) = sum;
        }
        if (channels == 1) {
            eight sum = {0.0};
            for (t = 0; t + 8 <= taps; t += 8)
                sum += *(const eight *)(weights + t) * *(const eight *)(first + t);
            for (; t < taps; t++)
                sum[t % 8] += weights[t] * first[t];
            *values = ((sum[0] + sum[4]) + (sum[2] + sum[6]))
                      + ((sum[1] + sum[5]) + (sum[3] + sum[7]));
            continue;
        }
        for (; c + 8 <= channels; c += 8)
            ADD_UP(eight);
        for (; c + 4 <= channels; c += 4)
            ADD_UP(four);
        for (; c + 2 <= channels; c += 2)
            ADD_UP(two);
        for (; c < channels; c++)
            ADD_UP(one);
    }
}

static int is_array(const Py_buffer *view, int dimensions, char type, Py_ssize_t size)
{
    return view->ndim == dimensions && view->itemsize == size && view->format[0] == type
           && view->format[1] == 0;
}

/* The arrays fit each other, and every sum lies within the samples. */
static int fit(const Py_buffer *samples, const Py_buffer *begin, const Py_buffer *fraction,
               const Py_buffer *polynomials, const Py_buffer *values)
{
    if (!is_array(samples, 2, 'd', 8) || !is_array(begin, 1, 'i', 4)
        || !is_array(fraction, 1, 'd', 8) || !is_array(polynomials, 2, 'd', 8)
        || !is_array(values, 2, 'd', 8))
        return 0;
    const Py_ssize_t count = begin->shape[0], taps = polynomials->shape[1];
    const Py_ssize_t last = samples->shape[0] - taps;
    if (fraction->shape[0] != count || values->shape[0] != count
        || values->shape[1] != samples->shape[1] || polynomials->shape[0] < 1)
        return 0;
    const int32_t *at = begin->buf;
    int inside = 1;
    for (Py_ssize_t i = 0; i < count; i++)
        inside &= at[i] >= 0 && at[i] <= last;
    return inside;
}

/* Return 0 where there is no memory. */
static int compute(Py_buffer *views)
{
    const Py_ssize_t order = views[3].shape[0], taps = views[3].shape[1];
    const Py_ssize_t width = (taps + 7) / 8 * 8;
    const double *polynomials = views[3].buf;
    double *table = aligned_alloc(64, (order + 1) * width * sizeof(double));
    if (table == NULL)
        return 0;
    memset(table, 0, (order + 1) * width * sizeof(double));
    for (Py_ssize_t k = 0; k < order; k++)
        memcpy(table + (order - 1 - k) * width, polynomials + k * taps, taps * sizeof(double));
    weighted_sums(views[0].buf, views[0].shape[1], views[1].buf, views[2].buf, views[1].shape[0],
                  table, order, taps, width, views[4].buf);
    free(table);
    return 1;
}

static PyObject *take(PyObject *self, PyObject *const *given, Py_ssize_t count)
{
    (void)self;
    Py_buffer views[5];
    int held = 0, done = 0;
    if (count != 5) {
        PyErr_SetString(PyExc_TypeError, "five arrays are needed");
        return NULL;
    }
    while (held < 5 && PyObject_GetBuffer(
               given[held], &views[held],
               PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (held == 4 ? PyBUF_WRITABLE : 0)) == 0)
        held++;
    if (held == 5 && !fit(&views[0], &views[1], &views[2], &views[3], &views[4])) {
        PyErr_SetString(PyExc_ValueError, "the arrays do not fit each other");
    } else if (held == 5) {
        Py_BEGIN_ALLOW_THREADS
        done = compute(views);
        Py_END_ALLOW_THREADS
        if (!done)
            PyErr_NoMemory();
    }
    while (held > 0)
        PyBuffer_Release(&views[--held]);
    if (!done)
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"weighted_sums", (PyCFunction)(void (*)(void))take, METH_FASTCALL,
     "weighted_sums(samples, begin, fraction, polynomials, values)\n--\n\n"
     "Write the weighted sums of samples (n, channels), from `begin` (m,) on, to values\n"
     "(m, channels). The weights are polynomials (power, tap) of 2 fraction - 1. Raises ValueError\n"
     "for arrays that do not fit, or sums beyond the samples."},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_weighted_sums", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__weighted_sums(void)
{
    return PyModule_Create(&module);
}
