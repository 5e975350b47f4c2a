/* Arrays that Python hands over, held for as long as C works on them; and half floats. */

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>
#include <string.h>

/* Zero to begin with; no function here holds more. */
typedef struct {
    Py_buffer views[32];
    int count;
} held_t;

/* Hold an array of so many bytes an item, by PyBUF_ flags; NULL, with an error set, if it is
 * something else, or an error was set before. */
static inline const Py_buffer *hold(held_t *held, PyObject *array, Py_ssize_t itemsize, int flags)
{
    Py_buffer *view = held->views + held->count;
    if (PyErr_Occurred() || PyObject_GetBuffer(array, view, flags))
        return NULL;
    held->count++;
    if (view->itemsize == itemsize)
        return view;
    PyErr_SetString(PyExc_ValueError, "an array of another type");
    return NULL;
}

/* What an array of so many numbers an item holds, each of so many bytes; NULL, with an error set, if
 * it is something else. Items are as many in all; a count below 0 is that of this one. */
static inline void *hold_as_many(held_t *held, PyObject *array, Py_ssize_t size, Py_ssize_t each,
                                 int flags, Py_ssize_t *count)
{
    const Py_buffer *own = hold(held, array, size, PyBUF_C_CONTIGUOUS | flags);
    if (!own)
        return NULL;
    if (*count < 0)
        *count = own->len / size / each;
    if (own->len == *count * each * size)
        return own->buf;
    PyErr_SetString(PyExc_ValueError, "arrays that are not as large");
    return NULL;
}

/* Whether arrays have one shape. */
static inline int alike(const Py_buffer *one, const Py_buffer *other)
{
    size_t size = (size_t)one->ndim * sizeof *one->shape;
    return one->ndim == other->ndim && !memcmp(one->shape, other->shape, size);
}

/* What a function returns that has held arrays: None, or NULL if an error is set. */
static inline PyObject *let_go(held_t *held)
{
    while (held->count > 0)
        PyBuffer_Release(&held->views[--held->count]);
    if (PyErr_Occurred())
        return NULL;
    Py_RETURN_NONE;
}

static inline int16_t least(int16_t one, int16_t other) { return one < other ? one : other; }
static inline int16_t most(int16_t one, int16_t other) { return one > other ? one : other; }

/* The value of a half that is not negative, by its bits; of one that is finite, if `finite`. */
static inline float value_of_bits(uint32_t half, int finite)
{
    uint32_t bits = half << 13;
    float value;
    if (!finite && half >= 0x7C00) {
        bits |= 0x7F800000;
        memcpy(&value, &bits, 4);
        return value;
    }
    memcpy(&value, &bits, 4);
    /* From one kind's bias of the exponent to the other's. */
    return value * 0x1p112f;
}

/* The bits of the half that a value is rounded to, without its sign; and that, as a half has it. */
static inline uint32_t bits_of_value(float value, uint32_t *sign)
{
    uint32_t bits;
    memcpy(&bits, &value, 4);
    *sign = bits >> 16 & 0x8000;
    bits &= 0x7FFFFFFF;
    if (bits > 0x7F800000)
        return 0x7E00;
    if (bits >= 0x477FF000)
        return 0x7C00;
    if (bits < 0x38800000) {
        /* Not normal: to the last place of a half's sum with this half, which is the same. */
        memcpy(&value, &bits, 4);
        value += 0.5f;
        memcpy(&bits, &value, 4);
        return bits - 0x3F000000;
    }
    /* To the nearest, or the even one of two, with the other kind's bias of the exponent. */
    return (bits + 0xFFF + (bits >> 13 & 1) - 0x38000000) >> 13;
}
