//! Loops that are compiled twice, for every processor and for those with AVX2, and give the same bits on both: they hold
//! no fused multiply-add and no sum whose order depends on the width of a vector.

/// Defines a function whose body is compiled for AVX2 as well and chosen when it is called; `name::portable` is the
/// plain form. What the body calls must be `#[inline(always)]` to profit.
macro_rules! dispatch {
    ($(#[$doc:meta])* $vis:vis fn $name:ident($($argument:ident: $kind:ty),* $(,)?) $(-> $result:ty)? $body:block) => {
        $(#[$doc])*
        $vis fn $name($($argument: $kind),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn wide($($argument: $kind),*) $(-> $result)? {
                    $name::portable($($argument),*)
                }
                if std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: the processor has what `wide` is compiled for.
                    #[allow(unsafe_code)]
                    return unsafe { wide($($argument),*) };
                }
            }
            $name::portable($($argument),*)
        }

        mod $name {
            use super::*;

            #[inline(always)]
            pub(super) fn portable($($argument: $kind),*) $(-> $result)? $body
        }
    };
}

pub(crate) use dispatch;
