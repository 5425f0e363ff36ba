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
 * number, and each array is read once. Here arrays are taken from Python; loops.h has the loops.
 */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Places of the sums: `count` u in each of the rows. */
struct places {
    const int32_t *origin;
    const double *begin, *length, *u;
    Py_ssize_t rows, count;
};

/* The loops of loops.h, with vectors of so many numbers. */
struct loops {
    long lanes;
    int (*weighted_sums)(const double *samples, Py_ssize_t channels, Py_ssize_t last,
                         const struct places *at, const double *table, double *room,
                         Py_ssize_t order, Py_ssize_t half, double *values);
    int (*frames)(const char *samples, Py_ssize_t channels, Py_ssize_t count,
                  Py_ssize_t channel_step, Py_ssize_t step, double *values);
    int (*copied)(const double *samples, Py_ssize_t count, double *values);
    void (*add_steps)(const char *values, Py_ssize_t count, Py_ssize_t apart, Py_ssize_t size,
                      const double *first, double *sum, double *squares);
    void (*add_products)(const double *table, Py_ssize_t lines, Py_ssize_t apart, Py_ssize_t rows,
                         const double *values, Py_ssize_t size, double *sums);
};

/* Vectors wider than the registers would be kept in memory, which takes ten times as long: the
 * loops are compiled for each width, and the widest that the processor has is taken. */
#define LANES 2
#define NAMED(name) name##_of_two
#include "loops.h"

#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__) && __GNUC__ >= 12
#define LANES 4
#define NAMED(name) name##_of_four
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v3")
#include "loops.h"
#pragma GCC pop_options

#define LANES 8
#define NAMED(name) name##_of_eight
#pragma GCC push_options
#pragma GCC target("arch=x86-64-v4")
#include "loops.h"
#pragma GCC pop_options

/* The loops with the widest vectors that the processor has, of at most so many numbers. */
static const struct loops *widest(long lanes)
{
    __builtin_cpu_init();
    if (lanes >= 8 && __builtin_cpu_supports("x86-64-v4"))
        return &loops_of_eight;
    if (lanes >= 4 && __builtin_cpu_supports("x86-64-v3"))
        return &loops_of_four;
    return &loops_of_two;
}
#else
static const struct loops *widest(long lanes)
{
    (void)lanes;
    return &loops_of_two;
}
#endif

static const struct loops *loops;

static PyObject *take_lanes(PyObject *self, PyObject *most)
{
    (void)self;
    const long lanes = PyLong_AsLong(most);
    if (lanes == -1 && PyErr_Occurred())
        return NULL;
    loops = widest(lanes);
    return PyLong_FromLong(loops->lanes);
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
    const int inside = loops->weighted_sums(views[0].buf, views[0].shape[1],
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
            finite = loops->copied(samples->buf, channels * count, values->buf);
        else
            finite = loops->frames(samples->buf, channels, count, channel_step, step, values->buf);
        Py_END_ALLOW_THREADS
    }
    return give_back(views, 2, fitted, finite ? Py_True : Py_False);
}

/* --- add steps: from the first of some arrays to all of them, and their squares --- */

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
        loops->add_steps(views[0].buf, views[0].shape[0], views[0].strides[0], size, views[1].buf,
                         views[2].buf, views[3].buf);
        Py_END_ALLOW_THREADS
    }
    return give_back(views, 4, fitted, Py_None);
}

/* --- add products: of a table with the rows of some arrays --- */

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
            loops->add_products(table->buf, table->shape[0], table->strides[0] / 8,
                                table->shape[1],
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
    {"take_lanes", take_lanes, METH_O,
     "take_lanes(most)\n--\n\nTake vectors of at most so many numbers; return how many they have."},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_in_c", NULL, -1, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__in_c(void)
{
    loops = widest(8);
    return PyModule_Create(&module);
}
