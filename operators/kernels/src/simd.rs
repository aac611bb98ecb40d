//! Loops that are compiled several times, for every processor and for those with AVX2 and AVX-512, and give the same bits on
//! all: they hold no fused multiply-add and no sum whose order depends on the width of a vector.

/// Defines a function whose body is compiled for AVX2 and AVX-512 as well and chosen when it is called; `name::portable` is
/// the plain form. What the body calls must be `#[inline(always)]` to profit.
#[macro_export]
macro_rules! dispatch {
    (
        $(#[$doc:meta])*
        $vis:vis fn $name:ident $(<$type:ident: $bound:ident>)? ($($argument:ident: $kind:ty),* $(,)?) $(-> $result:ty)? $body:block
    ) => {
        $(#[$doc])*
        $vis fn $name $(<$type: $bound>)? ($($argument: $kind),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide $(<$type: $bound>)? ($($argument: $kind),*) $(-> $result)? {
                    $name::portable($($argument),*)
                }
                #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
                fn widest $(<$type: $bound>)? ($($argument: $kind),*) $(-> $result)? {
                    $name::portable($($argument),*)
                }
                // SAFETY: the processor has what the functions are compiled for.
                #[allow(unsafe_code)]
                if $crate::simd::has_avx512() {
                    return unsafe { widest($($argument),*) };
                } else if std::arch::is_x86_feature_detected!("avx2") {
                    return unsafe { wide($($argument),*) };
                }
            }
            $name::portable($($argument),*)
        }

        mod $name {
            use super::*;

            #[inline(always)]
            pub(super) fn portable $(<$type: $bound>)? ($($argument: $kind),*) $(-> $result)? $body
        }
    };
}

pub use crate::dispatch;

/// Whether the processor has AVX-512 with all widths of vectors and numbers.
#[cfg(target_arch = "x86_64")]
pub fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
}
